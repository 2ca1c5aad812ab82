#!/usr/bin/env bash
# A scene on a SLURM cluster. From the top of the repository, whose .venv was made with the modules named below:
#   sbatch --nodes 8 jobs/slurm.sh DECK [--set SECTION.KEY=VALUE ...]
#SBATCH --job-name=mpitled
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=32
#SBATCH --cpus-per-task=1
#SBATCH --hint=nomultithread
#SBATCH --time=02:00:00
#SBATCH --signal=B:USR1@120 # two minutes before the time is up the run keeps a checkpoint and ends; the same job goes on from it
set -euo pipefail
[ $# -gt 0 ] || { echo "usage: sbatch [--nodes N] jobs/slurm.sh DECK [--set SECTION.KEY=VALUE ...]" >&2 && exit 2; }
cd "${SLURM_SUBMIT_DIR:-.}"
# module load openmpi hdf5
. jobs/environment.sh

deck=$1
shift
out=${OUT:-out/$(basename "$deck" .toml)}
ranks=${SLURM_NTASKS:-2}
mpitled build "$deck" --out "$out" "$@" # on one core; a model that is there already is used again
[ "$ranks" -lt 2 ] || mpitled partition "$out" "$ranks"

launch=(srun --mpi=pmix)
command -v srun >/dev/null || launch=(mpirun -n "$ranks")
"${launch[@]}" mpitled run "$deck" --out "$out" --resume "$@" &
job=$!
trap 'kill -USR1 "$job"' USR1 # srun and mpirun pass it on to every rank
status=0
wait "$job" || status=$?
[ "$status" -le 128 ] || { status=0 && wait "$job" || status=$?; } # the signal ended `wait`, not the job
exit "$status"
