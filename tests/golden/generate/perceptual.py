# /// script
# requires-python = ">=3.11"
# dependencies = ["lpips", "numpy", "safetensors", "torch", "torchvision"]
# ///
"""Golden values of LPIPS for the Rust tests, in tests/golden/perceptual.

    python tests/golden/generate/perceptual.py [FOLDER HEADS]

LPIPS is the authors' package with torchvision's networks, their weights made by a formula: weight
NAME of network NET (`vgg`, `alex`) is sqrt(6 / fan-in) * uniform("NET.NAME") and a bias
0.05 * uniform("NET.NAME"), heads are uniform squared / 10 (`uniform.py`), all rounded to float32.

`distances.safetensors`: `p`, `q` [2, 64, 75] are images in 255ths, `q` a blurred, darker, noisy `p`.
Per kind, computed in float64: `KIND/distance` [2], and of the gradient of their mean by `p`
`KIND/gradient` [67]: its largest magnitude, its norm, its product with uniform("probe.p"), and its values
at the flat indices 149 i. `lpips-alex/colour` [1] is the distance of the colours p[0], p[1], q[0] from q[0],
p[1], q[1], which are passed from 0 to 1 (`normalize=False`).

`zip.pth` and `plain.pth` are the two layouts of torch.save: `a.weight` [2, 3], `b.weight` [3, 2, 1, 1] (both
uniform(name)), `half` (16 bits), `turned` (not in rows) and `bad` (holds a NaN). `code.pth` calls a function.

With a FOLDER, for checking by hand: writes there the networks of the formula under torchvision's names, copies
of the published heads (HEADS/{vgg,alex}.pth), and prints the distances with these.
"""

import math
import shutil
import sys
import warnings
from pathlib import Path

import lpips
import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor
from uniform import uniform

OUT = Path(__file__).resolve().parents[1] / "perceptual"
NETS = {"vgg": "vgg16-397923af", "alex": "alexnet-owt-7be5be79"}


def images() -> tuple[Tensor, Tensor]:
    """Two pictures of discs and stripes, and what a poor restoration might make of them."""
    rows, columns = torch.meshgrid(torch.arange(64.0), torch.arange(75.0), indexing="ij")
    discs = (((rows - 30) ** 2 + (columns - 40) ** 2) < 300).double() * 0.5 + columns / 300
    stripes = 0.5 + 0.4 * torch.sin(rows / 2.5 + columns / 4) * (columns > 30)
    p = torch.stack([discs, stripes.double()])[:, None]
    blurred = F.avg_pool2d(F.pad(p, (1, 1, 1, 1), mode="replicate"), 3, 1)
    noise = torch.from_numpy(uniform("noise", p.numel())).reshape(p.shape)
    grain = torch.from_numpy(uniform("grain", p.numel())).reshape(p.shape)
    q = 0.9 * blurred + 0.1 * noise
    return [(x.clamp(0, 1) * 255).round().to(torch.uint8) for x in (p + 0.02 * grain, q)]


def parameter(name: str, shape: tuple[int, ...]) -> Tensor:
    values = uniform(name, math.prod(shape)).reshape(shape)
    if ".lin" in name:
        values = values**2 / 10
    elif len(shape) > 1:
        values = values * math.sqrt(6 / math.prod(shape[1:]))
    else:
        values = values * 0.05
    return torch.from_numpy(values.astype(np.float32))


def formula(net: str) -> tuple[lpips.LPIPS, dict[str, Tensor], dict[str, Tensor]]:
    """LPIPS, and the weights of backbone and heads under their published names."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = lpips.LPIPS(net=net, pretrained=False, pnet_rand=True, verbose=False)
    backbone = {}
    for part, module in model.net.named_children():  # slices of torchvision's `features`
        for name, value in module.state_dict().items():
            assert part.startswith("slice")
            backbone[f"features.{name}"] = parameter(f"{net}.features.{name}", tuple(value.shape))
            module.state_dict()[name].copy_(backbone[f"features.{name}"])
    heads = {}
    for tap, lin in enumerate(model.lins):
        name = f"lin{tap}.model.1.weight"
        weight = lin.model[1].weight
        heads[name] = parameter(f"{net}.{name}", tuple(weight.shape))
        weight.data.copy_(heads[name])
    return model.eval(), backbone, heads


def lpips_distance(model: lpips.LPIPS, p: Tensor, q: Tensor) -> Tensor:
    gray = lambda x: x.expand(-1, 3, -1, -1)
    return model(gray(p), gray(q), normalize=True).flatten()


def colour_distance(model: lpips.LPIPS, p: Tensor, q: Tensor) -> Tensor:
    p, q = ((x[:, 0].double() / 255).float().double() for x in (p, q))
    first, second = torch.stack([p[0], p[1], q[0]]), torch.stack([q[0], p[1], q[1]])
    return model(first[None], second[None], normalize=False).flatten().detach().float()


def add(tensors: dict[str, Tensor], kind: str, distance, p: Tensor, q: Tensor) -> None:
    p = (p.double() / 255).float().double().requires_grad_()
    q = (q.double() / 255).float().double()
    values = distance(p, q)
    values.mean().backward()
    flat = p.grad.flatten()
    probe = torch.from_numpy(uniform("probe.p", len(flat)))
    facts = torch.stack([flat.abs().max(), flat.norm(), flat @ probe])
    tensors[f"{kind}/distance"] = values.detach().float()
    tensors[f"{kind}/gradient"] = torch.cat([facts, flat[::149][:64]]).float()
    print(f"{kind}: {values.tolist()}, largest gradient {facts[0]:.2e}")


class Call:
    """Pickled, this asks whoever reads it to run a command."""

    def __reduce__(self):
        return print, ("executed",)


def state_dicts() -> None:
    value = lambda name, *shape: torch.from_numpy(uniform(name, math.prod(shape)).astype(np.float32)).reshape(shape)
    state = {
        "a.weight": value("a.weight", 2, 3),
        "b.weight": value("b.weight", 3, 2, 1, 1),
        "half": value("half", 4).half(),
        "turned": value("turned", 3, 2).T,
        "bad": torch.tensor([1.0, float("nan")]),
    }
    # One storage for two tensors: the second starts within it.
    state["both.first"], state["both.last"] = value("both", 10).split([4, 6])
    torch.save(state, OUT / "zip.pth")
    torch.save(state, OUT / "plain.pth", _use_new_zipfile_serialization=False)
    torch.save({"a.weight": Call()}, OUT / "code.pth")


def main() -> None:
    p, q = images()
    if len(sys.argv) == 3:
        folder, heads = map(Path, sys.argv[1:])
        for net, name in NETS.items():
            model, backbone, _ = formula(net)
            torch.save(backbone, folder / f"{name}.pth", _use_new_zipfile_serialization=net != "alex")
            shutil.copyfile(heads / f"{net}.pth", folder / f"{net}_lpips.pth")
            state = torch.load(heads / f"{net}.pth", map_location="cpu", weights_only=True)
            model.load_state_dict(state, strict=False)
            distances = lpips_distance(model, p.float() / 255, q.float() / 255)
            print(f"lpips-{net}: {distances.tolist()}")
        return
    OUT.mkdir(parents=True, exist_ok=True)
    tensors = {"p": p[:, 0].contiguous(), "q": q[:, 0].contiguous()}
    for net in NETS:
        model = formula(net)[0].double()
        add(tensors, f"lpips-{net}", lambda p, q: lpips_distance(model, p, q), p, q)
        if net == "alex":
            tensors["lpips-alex/colour"] = colour_distance(model, p, q)
    save_file(tensors, OUT / "distances.safetensors")
    state_dicts()
    for path in OUT.iterdir():
        path.chmod(0o644)
        print(f"{path.name}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
