#!/usr/bin/env bash
# Two hosts on one machine: network namespaces TAGa and TAGb with a cable (veth), so that ranks communicate over TCP.
#   two_hosts.sh up TAG            creates the hosts (root)
#   two_hosts.sh run TAG WORDS...  starts a command by mpirun on the first host, with one rank on each host
#   two_hosts.sh cut TAG           cuts the cable
#   two_hosts.sh down TAG          kills the processes on the hosts and removes the hosts
# The hosts detect a cut cable by timeouts only: keep-alive of the launcher (1 s here, 5 minutes by default) and retries
# of TCP (tcp_retries2: 3 here; the default takes 15 minutes).
set -euo pipefail
verb=$1 tag=$2
shift 2
declare -A address=([a]=10.213.47.1 [b]=10.213.47.2)

on() { # HOST WORDS...: runs a command on a host, with the name of the host
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
    # A subshell, because exec would prevent the removal of the agent's file.
    (on a mpirun --host "${address[a]}:1,${address[b]}:1" --bind-to none --mca plm_rsh_agent "$agent" "${net[@]}" \
        -x PATH -x PYTHONPATH -x OMP_NUM_THREADS "$@")
    ;;
agent) # mpirun's replacement of ssh
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
