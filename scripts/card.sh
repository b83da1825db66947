#!/bin/sh
# Trains on a machine with a graphics card that is had for a quarter of an hour. Nothing is installed or
# fetched there: it needs an NVIDIA driver and a Python with the PyTorch that the program was built with.
#
#     scripts/card.sh train QUDI PACK WEIGHTS OUT SECONDS [RECIPE [--set KEY=VALUE...]]
#
# QUDI is the program, built with `--features qudi-cli/libtorch` (docs/notes/training/graphics-cards.md). It
# tests the card, measures the speed of training on every backend that the program has, trains from WEIGHTS on
# the fastest for what is left of SECONDS, and leaves the weights in OUT every twenty seconds, in half
# precision, with metrics and a report. DEVICES=libtorch-cpu rehearses it on the processor; BATCH is the
# number of samples of a step, 64 by default.
#
#     scripts/card.sh parts FILE FOLDER
#
# cuts FILE into parts of at most 48 MiB that travel one by one; `cat FOLDER/*.part > FILE` joins them.
set -eu

parts() {
    mkdir -p "$2"
    split -b 48M -d --additional-suffix=.part "$1" "$2/$(basename "$1")."
    ls -l "$2"
}

# Prints a number of a JSON document.
number() {
    python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))["speed"][sys.argv[2]])' "$1" "$2"
}

train() {
    start=$(date +%s)
    qudi=$(realpath "$1") pack=$(realpath "$2") weights=$(realpath "$3")
    mkdir -p "$4"
    out=$(realpath "$4") seconds=$5 recipe=${6:-window}
    shift 6 2>/dev/null || shift $#
    cores=$(nproc)
    workers=$((cores > 3 ? cores - 2 : 1))
    batch=${BATCH:-64}
    torch=$(python3 -c 'import os, torch; print(os.path.join(os.path.dirname(torch.__file__), "lib"))')
    export LD_LIBRARY_PATH="$torch${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
    left() { echo $((seconds - ($(date +%s) - start))); }
    note() { echo "== $(($(date +%s) - start)) s: $*"; }

    note "devices"
    "$qudi" --version
    "$qudi" info --devices
    devices=${DEVICES:-$("$qudi" info --devices | grep -oE '^(libtorch|cuda):0' || true)}
    if [ -z "$devices" ]; then
        echo "no card: the program sees none, or was built without \`libtorch\` and \`cuda\`" >&2
        exit 2
    fi
    if command -v nvidia-smi >/dev/null; then
        nvidia-smi --query-gpu=timestamp,name,utilization.gpu,memory.used,power.draw \
            --format=csv -l 1 >"$out/card.csv" 2>/dev/null &
        watcher=$!
        trap 'kill $watcher 2>/dev/null || true' EXIT
    fi

    best=0 device=
    for one in $devices; do
        note "selftest on $one"
        # Products of 32 bits, as on a processor; training may use fewer.
        NVIDIA_TF32_OVERRIDE=0 timeout 150 "$qudi" selftest --device "$one" || {
            note "$one fails"
            continue
        }
        note "speed on $one"
        name=$(echo "$one" | tr : -)
        timeout 120 "$qudi" bench --train "$recipe" --pack "$pack" --device "$one" \
            --workers "$workers" --seconds "${BENCH_SECONDS:-20}" --json \
            --set train.batch="$batch" "$@" >"$out/bench-$name.json" || continue
        cat "$out/bench-$name.json"
        rate=$(number "$out/bench-$name.json" samples_per_second)
        if [ "$(python3 -c "print(int($rate > $best))")" = 1 ]; then
            best=$rate device=$one
        fi
    done
    test -n "$device"

    # The learning rate falls to its end with the time that is left; 25 s are for validation and the end.
    time=$(($(left) - 25))
    steps=$(python3 -c "print(max(2, int(0.93 * $best * $time / $batch)))")
    every=$(python3 -c "print(max(1, int($best * 60 / $batch)))")
    note "training on $device: $steps steps of $batch in $time s"
    run=$(mktemp -d)/run
    (
        while sleep 20; do
            cp "$run/metrics.jsonl" "$out/" 2>/dev/null || true
            "$qudi" publish "$run/weights.safetensors" -o "$out/weights.safetensors" -f -q 2>/dev/null || true
        done
    ) &
    copier=$!
    "$qudi" train "$recipe" --pack "$pack" --init "$weights" --device "$device" \
        --workers "$workers" --seconds "$time" -o "$run" --set train.batch="$batch" \
        --set train.steps="$steps" --set train.checkpoint="$every" \
        --set validation.every="$steps" "$@" || note "training ended with $?"
    kill $copier 2>/dev/null || true
    wait $copier 2>/dev/null || true
    cp "$run/metrics.jsonl" "$run/report.html" "$run/recipe.toml" "$run/environment.json" "$out/" 2>/dev/null || true
    "$qudi" publish "$run/weights.safetensors" -o "$out/weights.safetensors" -f
    samples=$(python3 -c "
import json, sys
steps = [json.loads(line) for line in open(sys.argv[1])]
steps = [line for line in steps if line['kind'] == 'step']
print(len(steps) * $batch)" "$out/metrics.jsonl")
    note "$samples samples. To go on: qudi train $recipe --data DATA --init $(basename "$out")/weights.safetensors -o RUN"
}

case "${1:-}" in
parts) shift && parts "$@" ;;
train) shift && train "$@" ;;
*) sed -n '2,16p' "$0" && exit 2 ;;
esac
