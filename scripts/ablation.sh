#!/bin/sh
# Ablation study: trains the stage `perception` of `paper-mini` from one set of weights, whole and without one
# part, on identical samples for equally many steps; then evaluates 1 and 10 steps at two light levels.
#
#     scripts/ablation.sh PATH/TO/qudi DATA BACKBONES WEIGHTS CLIPS OUT STEPS [VARIANT...]
#
# BACKBONES are the weights of LPIPS, WEIGHTS the result of the stage before (RUN/3-mean/weights.safetensors).
# Variants: whole physics flow fusion self-conditioning lpips. Compare the results with
# `scripts/compare/paired.py OUT/whole.json OUT/flow.json`.
set -eu
qudi=$1 data=$2 backbones=$3 weights=$4 clips=$5 out=$6 steps=$7
shift 7
[ $# -gt 0 ] || set -- whole physics flow fusion self-conditioning lpips
recipe=$(dirname "$0")/../configs/paper-mini.toml
mkdir -p "$out"
# What all stages have in common, and the fourth, "perception".
awk "/^\\[\\[stage\\]\\]/ { n++ } n == 0 || n == 4" "$recipe" >"$out/recipe.toml"

for part in "$@"; do
    case $part in
    whole) set_part="network.ablate=[]" ;;
    lpips) set_part='train.loss={ prediction = 1.0, pre = 0.2, perceptual = 0.0, term = "none", flow = 10.0 }' ;;
    *) set_part="network.ablate=[\"$part\"]" ;;
    esac
    "$qudi" train "$out/recipe.toml" --init "$weights" --data "$data" --pack "$out/pack.zip" --backbones "$backbones" \
        -o "$out/$part" --set train.steps="$steps" --set validation.every="$steps" --set validation.crop=64 \
        --set "$set_part"
    "$qudi" eval "$clips" --frames 5 --seed 1 --ppp 3.25,9.75 --method qudi --steps 1,10 --spacing linear \
        --weights "$out/$part/weights.safetensors" --appearance --backbones "$backbones" --json >"$out/$part.json"
done
