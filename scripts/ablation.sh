#!/bin/sh
# What each part of the method is worth: the tiny network on the small recipe's data, whole and with one part left out,
# on identical photons for equally many steps. Prints gain-aligned PSNR on the validation clips at every light.
#
#     qudi train small --data DATA --pack PACK --cache-only
#     scripts/ablation.sh PATH/TO/qudi PACK OUT [STEPS] [VARIANT...]
set -eu
qudi=$1 pack=$2 out=$3 steps=${4:-4000}
[ $# -gt 4 ] && shift 4 || set -- whole physics flow self-conditioning exposure
configs=$(dirname "$0")/../configs
# Everything learns, not only the pre-denoiser.
loss='{ prediction = 1.0, pre = 0.2, perceptual = 0.0, term = "none", flow = 30.0 }'
mkdir -p "$out"
{ sed -n '/^\[network\]/,/^$/p' "$configs/tiny.toml"; sed -n '/^\[data\]/,$p' "$configs/small.toml"; } >"$out/recipe.toml"

for part in "$@"; do
    ablate="[]"
    [ "$part" = whole ] || ablate="[\"$part\"]"
    "$qudi" train "$out/recipe.toml" -o "$out/$part" --pack "$pack" --device cpu --json \
        --set "network.ablate=$ablate" --set train.steps="$steps" --set train.lr=4e-3 \
        --set train.crops='{ bursts = 300, cached_frames = 5, frames = 5, side = 96 }' --set train.batch=2 --set train.loss="$loss" \
        --set validation.every="$steps" --set validation.steps=10 >"$out/$part.json"
    printf '%s' "without $part:"
    sed -n 's/.*"ppp": \([0-9.]*\).*/ \1 PPP/p; s/.*"psnr_a": \([0-9.]*\).*/ \1 dB/p' "$out/$part.json" | tr '\n' ' '
    echo
done
