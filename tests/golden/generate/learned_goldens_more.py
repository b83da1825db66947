# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Golden values of QUIVER, FloRNN and RVRT for the Rust tests, in tests/golden/learned.

    python tests/golden/generate/learned_goldens_more.py [FILE ...]

The format is that of network_goldens.py, but for cut gradients: after norm and product come the first FIRST values.
Parameters carry the names of the authors' weight files, in PyTorch's layout, 3-D convolutions of RVRT as such. Some
are `uniform.parameter(name)` times a power of two (FACTORS, by the end of the name): flows are then some tenths of a
pixel to some pixels. All weights of `pwcnet` that have more than one dimension are times 3/2 first (in float32), as
leaky ReLUs halve the variance. Buffers (means, deviations, places in windows) are those of the networks, PWC-Net has
no gradients, and of parameters that serve several times (`predenoise.rdbs`) the file knows the first name alone.

`quiver`, `quiver_loss`, `quiver_long` (more frames than a window), `flornn` (with and without loss), `rvrt`,
`rvrt_loss`: whole networks, `about.config` their sizes. `loss` is that of training, of the outputs and `truth`.

`parts`: operations and blocks, `about.operation` names them.
"""

import math
import sys
from collections.abc import Callable

import flornn
import network_goldens
import quiver
import rvrt
import torch
import warping
from network_goldens import OUT, File, Tensors, given, kinks, spread
from torch import Tensor, nn
from uniform import parameter

FIRST = 14
FACTORS = {
    "basic_module.8.weight": 1.0,
    "conv_offset.6.weight": 0.125,
    "conv_offset.10.weight": 0.125,
}
bilinear = warping.bilinear
reached: list[tuple[float, float]] = []


def watched(x: Tensor, columns: Tensor, rows: Tensor, padding: str = "zeros") -> Tensor:
    for at, size in ((columns, x.shape[3]), (rows, x.shape[2])):
        at = at.detach().double()
        bends = (at > -1.5) & (at < size + 0.5) if padding == "zeros" else (at > -0.5) & (at < size - 0.5)
        bends &= at != at.round()
        if columns.requires_grad and bends.any():
            kinks.nearest = min(kinks.nearest, (at - at.round()).abs()[bends].min().item())
    return bilinear(x, columns, rows, padding)


warping.bilinear = watched


def scaled(name: str, shape: tuple[int, ...]):
    values = parameter(name, shape)
    if name.startswith("pwcnet.") and len(shape) > 1:
        values = values * values.dtype.type(1.5)
    for end, factor in FACTORS.items():
        if name.endswith(end):
            values = values * values.dtype.type(factor)
    return values


network_goldens.parameter = scaled
