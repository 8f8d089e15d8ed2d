#!/bin/bash
#SBATCH --cpus-per-task=8 --mem=8G --time=04:00:00 --signal=B:TERM@120 --requeue
# Frames of a shot, a share of them for each job of an array:
#     sbatch --array=0-15 slurm-shot.sh SCENE OUT 0:240
set -eu
exec ngpt render "$1" --frames "$3" --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" --sampler gpt \
    --skip-existing -o "$2"
