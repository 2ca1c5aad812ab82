#!/usr/bin/env bash
# The main job: sets up what is missing, then grows a tumour in a brain on two ranks. Arguments go to `mpitled run`.
set -euo pipefail
cd "$(dirname "$0")/.."
. jobs/environment.sh
mpirun --bind-to none --oversubscribe -n "${RANKS:-2}" mpitled run jobs/brain_tumour.toml "$@"
