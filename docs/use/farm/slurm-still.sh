#!/bin/bash
#SBATCH --cpus-per-task=8 --mem=8G --time=04:00:00 --signal=B:TERM@120 --requeue
# One image of PARTS * SPP samples per pixel, as an array of jobs and one that merges them:
#     ./slurm-still.sh SCENE OUT PARTS SPP
set -eu
scene=$1 out=$2 parts=$3 spp=$4
if [ -z "${SLURM_ARRAY_TASK_ID:-}" ]; then
    mkdir -p "$out"
    job=$(sbatch --parsable --array="1-$parts" --output="$out/part.%a.log" --open-mode=append "$0" "$@")
    sbatch --dependency="afterok:$job" --output="$out/merge.log" --wrap "set -e
        ngpt merge '$out'/part.*.exr -o '$out/stack.exr' --force
        ngpt denoise '$out/stack.exr' -o '$out/image.exr' --force"
    exit
fi
trap 'kill -TERM $(jobs -p)' TERM
ngpt render "$scene" --seed "$SLURM_ARRAY_TASK_ID" --spp "$spp" --sampler gpt --skip-existing \
    -o "$out/part.$SLURM_ARRAY_TASK_ID.exr" &
wait $! || true  # until it ends, or the signal comes
status=0
wait $! || status=$?
# Two minutes before its time is over, the part was told to write what it has. The same job goes on with it.
if [ $status = 143 ]; then scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"; fi
exit $status
