#!/usr/bin/env bash
# A scene on a PBS cluster. From the top of the repository, whose .venv was made with the modules named below:
#   qsub -l select=8:ncpus=32:mpiprocs=32 -v DECK=jobs/brain_tumour.toml,SET="solver.load_time=4 output.frames=5" jobs/pbs.sh
# SET: keys with their values, blanks between them; a value with commas has to be in the deck, for qsub splits at them.
#PBS -N mpitled
#PBS -l select=4:ncpus=32:mpiprocs=32
#PBS -l place=scatter:excl
#PBS -l walltime=02:00:00
#PBS -j oe
set -euo pipefail
[ -n "${DECK:-}" ] || { echo "usage: qsub -v DECK=FILE[,SET=\"SECTION.KEY=VALUE ...\"] jobs/pbs.sh" >&2 && exit 2; }
cd "${PBS_O_WORKDIR:-.}"
# module load openmpi hdf5
. jobs/environment.sh

seconds=${RUN_SECONDS:-7080} # two minutes less than the walltime: the run keeps a checkpoint and ends; the same job goes on
deck=$DECK
set --
for key in ${SET:-}; do set -- "$@" --set "$key"; done
out=${OUT:-out/$(basename "$deck" .toml)}
ranks=2
[ -z "${PBS_NODEFILE:-}" ] || ranks=$(wc -l <"$PBS_NODEFILE")
mpitled build "$deck" --out "$out" "$@" # on one core; a model that is there already is used again
[ "$ranks" -lt 2 ] || mpitled partition "$out" "$ranks"

# mpirun passes the signal on to every rank.
timeout --signal=USR1 --preserve-status "$seconds" \
    mpirun -n "$ranks" ${PBS_NODEFILE:+--hostfile "$PBS_NODEFILE"} mpitled run "$deck" --out "$out" --resume "$@"
