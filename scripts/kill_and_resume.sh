#!/bin/sh
# Trains twice: once undisturbed, once killed with SIGKILL repeatedly and resumed. The weights and the whole
# training state must be the same, bit for bit.
#
#     scripts/kill_and_resume.sh PATH/TO/qudi [KILLS] [STEPS]
set -eu
qudi=$1 kills=${2:-20} steps=${3:-300}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
options="--device cpu --quiet --set train.steps=$steps --set train.checkpoint=5 --set data.crop=32 --set data.frames=3
    --set validation.every=50 --set validation.crop=32"

# shellcheck disable=SC2086 # several options
"$qudi" train tiny -o "$folder/whole" $options

killed=0
resume=
while :; do
    # shellcheck disable=SC2086
    "$qudi" train tiny -o "$folder/killed" $options $resume &
    run=$!
    if [ "$killed" -lt "$kills" ]; then
        # Between 0.3 and 1.3 seconds: in the middle of steps, of states being written, of validations.
        sleep "$(awk -v seed="$killed" 'BEGIN { srand(seed + 7); print 0.3 + rand() }')"
        kill -KILL "$run" 2>/dev/null || true
    fi
    if wait "$run" 2>/dev/null; then break; fi
    killed=$((killed + 1))
    # A run killed before its first state starts anew; one killed later goes on.
    resume=--force
    if [ -d "$folder/killed/state" ] || [ -d "$folder/killed/state.old" ]; then resume=--resume; fi
done

echo "killed $killed times"
cmp "$folder/whole/weights.safetensors" "$folder/killed/weights.safetensors"
cmp "$folder/whole/state/tensors.safetensors" "$folder/killed/state/tensors.safetensors"
lines=$(grep -c '"kind":"step"' "$folder/killed/metrics.jsonl")
[ "$lines" -eq "$steps" ] || { echo "$lines lines of metrics for $steps steps" >&2; exit 1; }
echo "same weights, same state, every step logged once"
