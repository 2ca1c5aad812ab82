#!/usr/bin/env bash
# Two hosts on one machine: network namespaces TAGa and TAGb with a cable (veth) between them, so that ranks talk over TCP.
#   two_hosts.sh up TAG            makes them (root)
#   two_hosts.sh run TAG WORDS...  mpirun of a command with one rank on each, started on the first
#   two_hosts.sh cut TAG           takes the cable out
#   two_hosts.sh down TAG          ends what is left on them, and removes them
# A cable that is cut says nothing. So the launcher asks the other host every second (keep-alive), and the hosts give up
# what is not acknowledged after some tries (tcp_retries2): a cluster's defaults are 5 and 15 minutes.
set -euo pipefail
verb=$1 tag=$2
shift 2
declare -A address=([a]=10.213.47.1 [b]=10.213.47.2)

on() { # HOST WORDS...: a command on a host, which knows itself by that name
    local host=$1
    shift
    exec ip netns exec "$tag$host" unshare --uts sh -c 'hostname "$0" && exec "$@"' "$tag$host" "$@"
}

case $verb in
up)
    for host in a b; do ip netns add "$tag$host"; done
    ip link add "${tag}0" netns "${tag}a" type veth peer name "${tag}0" netns "${tag}b"
    for host in a b; do
        ip -n "$tag$host" address add "${address[$host]}/30" dev "${tag}0"
        ip -n "$tag$host" link set lo up
        ip -n "$tag$host" link set "${tag}0" up
        ip netns exec "$tag$host" sysctl -qw net.ipv4.tcp_retries2=3
    done
    ;;
run)
    agent=$(mktemp)
    trap 'rm -f "$agent"' EXIT
    printf '#!/bin/sh\nexec "%s" agent "%s" "$@"\n' "$(realpath "$0")" "$tag" >"$agent"
    chmod +x "$agent"
    net=(--mca pml ob1 --mca btl "tcp,self" --mca btl_tcp_if_include 10.213.47.0/30 --mca oob_tcp_if_include 10.213.47.0/30)
    net+=(--mca oob_tcp_keepalive_time 1 --mca oob_tcp_keepalive_intvl 1 --mca oob_tcp_keepalive_probes 3)
    # Not exec: the agent's file goes when mpirun ends.
    (on a mpirun --host "${address[a]}:1,${address[b]}:1" --bind-to none --mca plm_rsh_agent "$agent" "${net[@]}" \
        -x PATH -x PYTHONPATH -x OMP_NUM_THREADS "$@")
    ;;
agent) # mpirun's way to another host, in place of ssh
    for host in a b; do
        if [ "$1" = "${address[$host]}" ]; then
            shift
            on "$host" sh -c "$*"
        fi
    done
    echo "$1: there is no such host" >&2
    exit 1
    ;;
cut)
    ip -n "${tag}a" link set "${tag}0" down
    ;;
down)
    for host in a b; do
        [ -e "/run/netns/$tag$host" ] || continue
        ip netns pids "$tag$host" | xargs -r kill -9
        ip netns delete "$tag$host"
    done
    ;;
*)
    sed -n '2,8p' "$0" >&2
    exit 2
    ;;
esac
