#!/bin/sh
# Ablation study: trains the last stage of `paper-mini` from one set of weights, whole and without one part,
# on identical samples for equally many steps. Prints the last validation of each.
#
#     scripts/ablation.sh PATH/TO/qudi DATA WEIGHTS OUT STEPS [VARIANT...]
#
# WEIGHTS are the result of the stage before (RUN/2-crops/weights.safetensors).
# Variants: whole forward-model flow fusion self-conditioning. Weights do not keep what was left out.
set -eu
qudi=$1 data=$2 weights=$3 out=$4 steps=$5
shift 5
[ $# -gt 0 ] || set -- whole forward-model flow fusion self-conditioning
recipe=$(dirname "$0")/../crates/qudi-model/recipes/paper-mini.toml
mkdir -p "$out"
# The common part of the recipe, and its third stage, "mean".
awk "/^\\[\\[stage\\]\\]/ { n++ } n == 0 || n == 3" "$recipe" >"$out/recipe.toml"

for part in "$@"; do
    case $part in
    whole) set_part="train.ablate=[]" ;;
    *) set_part="train.ablate=[\"$part\"]" ;;
    esac
    "$qudi" train "$out/recipe.toml" --init "$weights" --data "$data" --pack "$out/pack.zip" \
        -o "$out/$part" --set train.steps="$steps" --set validation.every="$steps" --set "$set_part"
    printf '%s ' "$part"
    tail -n 1 "$out/$part/metrics.jsonl"
done
