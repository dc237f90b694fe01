#!/bin/bash
# A SLURM job array over the stacks named in a file, one a line:
#
#     ls stacks/*.tif > stacks.txt
#     sbatch --array=0-19 slurm-array.sh stacks.txt --config estimate.toml
#
# Task k of n takes every n-th stack from the k-th on, so the array may have any size. What follows the list
# goes to `trap-motion estimate`. Submitting it again does only what is missing.
#SBATCH --job-name=trap-motion
#SBATCH --array=0-19
#SBATCH --cpus-per-task=4
#SBATCH --mem-per-cpu=2G
#SBATCH --time=04:00:00
#SBATCH --output=trap-motion-%A_%a.log
set -euo pipefail

list=$1
shift
mapfile -t stacks < "$list"
mine=()
for ((i = SLURM_ARRAY_TASK_ID; i < ${#stacks[@]}; i += SLURM_ARRAY_TASK_COUNT)); do
    mine+=("${stacks[i]}")
done
if ((${#mine[@]} == 0)); then
    exit 0
fi

export OMP_NUM_THREADS=1 # one stack for each of the task's cores
status=0
trap-motion estimate "${mine[@]}" "$@" --resume --jobs "${SLURM_CPUS_PER_TASK:-1}" \
    --summary "summary-$SLURM_ARRAY_TASK_ID.csv" || status=$?
# 4: all results are written, and the table says which of them can't be trusted
((status == 4)) || exit "$status"
