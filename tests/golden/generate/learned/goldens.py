# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "safetensors", "torch"]
# ///
"""Golden values of learned baselines for the Rust tests, in tests/golden/learned.

    python tests/golden/generate/learned/goldens.py [FILE ...]

Files are as in `network_goldens.py`, with gradients of more than 64 values cut. The networks are those of
`emvd.py`, `spk2imgnet.py`, `memdeblur.py` and `student_teacher.py`; `about.config` has `network` and the sizes that
differ from the defaults there. Parameters have the names of weight files, without a prefix.

Buffers of a network are listed with their shapes in `about.buffers`: a `running_mean` is 0.1 * uniform(full name), a
`running_var` 1 + 0.5 * uniform(full name), rounded to float32.

`loss` and `training*` are cases of the training loss, which is their first output, of shape [1], and of its
gradients; no gradient of the input `truth`.

- `emvd`: `step` of the images `previous` and `current`; `sequence` of the frames `x`: `refine` of all steps and
  `fusion` of the last.
- `spk2imgnet`: outputs as the network gives them, not divided by 0.6.
- `memdeblur`: frames 5 and 10 of the three scales, the coarsest first, with the memory of evaluation. All statistics
  of batch normalisations are the running ones.
- `memdeblur_training`: `training` has the memory of training and those statistics; `training_batch` takes
  statistics of batches, and `mean` and `variance` are the running ones of `memory.key_encoder.bn1` afterwards.
- `student_teacher`: `student` is one network; in `loss` are three, with names `student.*`, `motion.*`, `denoising.*`,
  and inputs `noisy`, `clean` and `still`, at `about.iteration`. No gradient of the teachers and their inputs.

In `memdeblur*` there is no gradient of parameters without use (`conv_hr`, `conv_last`), nor of those whose gradient
is zero but for rounding: `memory.key_proj.key_proj.bias`, which moves keys and queries alike, and in `training_batch`
biases of convolutions before batch normalisations.
"""

import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import emvd
import memdeblur
import numpy as np
import spk2imgnet
import student_teacher
import torch
from network_goldens import OUT, File, Tensors, fill, kinks, spread
from torch import Tensor, nn
from uniform import uniform

LIGHT = (0.5, 0.5)


def image(*shape: int) -> dict:
    return spread(shape, *LIGHT)


def file(name: str) -> File:
    result = File(name, 64)
    result.folder = "learned"
    return result


def fill_buffers(module: nn.Module) -> dict[str, list[int]]:
    """Their shapes."""
    shapes: dict[str, list[int]] = {}
    for name, buffer in module.named_buffers():
        if buffer.is_floating_point():
            offset, scale = (0, 0.1) if name.endswith("running_mean") else (1, 0.5)
            values = (offset + scale * uniform(name, buffer.numel())).astype(np.float32)
            buffer.copy_(torch.from_numpy(values))
            shapes[name] = list(buffer.shape)
    return shapes


def only(loss: Callable[[Tensors, Tensors], Tensor], *kept: str) -> Callable[[Tensors, Tensors], Tensor]:
    """A loss which replaces the outputs of its case, but for those to be kept."""

    def run(outputs: Tensors, inputs: Tensors) -> Tensor:
        total = loss(outputs, inputs)
        others = {name: outputs[name] for name in kept}
        outputs.clear()
        outputs.update({"loss": total.reshape(1)} | others)
        return total

    return run


def emvd_file() -> File:
    result = file("emvd")
    sizes = {"width": 4}
    net = emvd.Emvd(**sizes)
    about = {"config": {"network": "emvd"} | sizes}
    inputs = {"previous": image(2, 4, 16, 24), "current": image(2, 4, 16, 24)}
    result.case("step", lambda previous, current: net.step(previous, current)._asdict(), inputs, net, about=about)

    def sequence(x: Tensor) -> Tensors:
        steps = net(x)
        return {"refine": torch.stack([step.refine for step in steps], 1), "fusion": steps[-1].fusion}

    inputs = {"x": image(2, 3, 4, 16, 16)}
    result.case("sequence", sequence, inputs, net, about=about)
    steps: list[emvd.Step] = []

    def run(x: Tensor) -> Tensors:
        steps[:] = net(x)
        return {}

    loss = only(lambda outputs, values: emvd.loss(net, steps, values["truth"]))
    result.case("loss", run, inputs | {"truth": image(2, 3, 4, 16, 16)}, net, "", about, ("truth",), loss)
    return result


def watched(x: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """`spk2imgnet.sample`; `File` prints how near the nearest place comes to a whole coordinate."""
    for place, size in ((row.detach().double(), x.shape[2]), (column.detach().double(), x.shape[3])):
        bends = (place > -1.5) & (place < size + 0.5)
        kinks.nearest = min(kinks.nearest, (place - place.round()).abs()[bends].min().item())
    return sample(x, row, column)


sample, spk2imgnet.sample = spk2imgnet.sample, watched


def spk2imgnet_file() -> File:
    result = file("spk2imgnet")
    # Two channels per offset group, to see their order.
    sizes = {"features": 16, "stem": 4, "blocks": 2}
    net = spk2imgnet.Spk2ImgNet(**sizes)
    about = {"config": {"network": "spk2imgnet"} | sizes}

    def run(x: Tensor) -> Tensors:
        y, estimates = net(x)
        return {"y": y} | {f"estimate_{k}": estimate for k, estimate in enumerate(estimates)}

    # Chosen so that no place at which a map is read is within 3e-6 of a kink.
    inputs = {"x": spread((2, 10, 8, 12), 0.53, 0.528)}
    result.case("forward", run, inputs, net, about=about)

    def loss(outputs: Tensors, values: Tensors) -> Tensor:
        return spk2imgnet.loss(outputs["y"], [outputs[f"estimate_{k}"] for k in range(5)], values["truth"])

    truth = {"truth": image(2, 10, 8, 12)}
    result.case("loss", run, inputs | truth, net, "", about, ("truth",), only(loss))
    return result


SCALES = ("quarter", "half", "full")
# Of memory: biases of the convolutions before batch normalisations.
BEFORE_STATISTICS = ("encoder.conv1.bias", "mem.conv1.bias", "feat.conv1.bias", "downsample.0.bias")
BEFORE_STATISTICS += tuple(f"layer1.{k}.conv{j}.bias" for k in range(3) for j in (1, 2, 3))


def memdeblur_net() -> tuple[memdeblur.MemDeblur, dict]:
    sizes = {"channels": 3, "features": 8, "forward_blocks": 2, "backward_blocks": 2}
    sizes |= {"memory_blocks": 1, "bottlenecks": 2, "top": 5}
    net = memdeblur.MemDeblur(**sizes)
    for leaf in (net.conv_hr, net.conv_last, net.memory.key_proj.key_proj.bias):
        leaf.requires_grad_(False)
    return net, {"config": {"network": "memdeblur"} | sizes, "buffers": fill_buffers(net)}


def memdeblur_file() -> File:
    result = file("memdeblur")
    net, about = memdeblur_net()
    net.eval()

    def run(x: Tensor) -> Tensors:
        fill_buffers(net)
        return {name: y[:, [5, 10]] for name, y in zip(SCALES, net(x, training=False))}

    about |= {"memory": "evaluation", "frames": [5, 10], "statistics": "running"}
    result.case("evaluation", run, {"x": image(2, 11, 3, 32, 24)}, net, about=about)
    return result


def memdeblur_training_file() -> File:
    result = file("memdeblur_training")
    net, about = memdeblur_net()
    first = net.memory.key_encoder.bn1

    def run(x: Tensor) -> Tensors:
        fill_buffers(net)
        outputs = dict(zip(SCALES, net(x, training=True)))
        return outputs | {"mean": first.running_mean.clone(), "variance": first.running_var.clone()}

    loss = lambda outputs, values: memdeblur.loss([outputs[name] for name in SCALES], values["truth"])
    # Statistics of fewer images of one cell turn on the last digit.
    for case, batch, shape in (("training", False, (2, 11, 3, 32, 24)), ("training_batch", True, (8, 6, 3, 32, 24))):
        net.train(batch)
        for name, parameter in net.memory.named_parameters():
            if batch and name.endswith(BEFORE_STATISTICS):
                parameter.requires_grad_(False)
        inputs = {name: image(*shape) for name in ("x", "truth")}
        statistics = {"memory": "training", "statistics": "batch" if batch else "running"}
        kept = ("mean", "variance") if batch else ()
        result.case(case, run, inputs, net, "", about | statistics, ("truth",), only(loss, *kept))
    return result


def student_teacher_file() -> File:
    result = file("student_teacher")
    sizes = {"frames": 5, "features": 4, "kernel": 5}
    about = {"config": {"network": "student-teacher-like"} | sizes}
    net = student_teacher.Network(**sizes)
    result.case("student", lambda x: net(x), {"x": image(2, 5, 16, 24)}, net, about=about)
    training = student_teacher.Training(**sizes)
    iteration = 20_000
    loss = only(lambda outputs, values: training.loss(**values, iteration=iteration))
    inputs = {name: image(2, 5, 16, 24) for name in ("noisy", "clean", "still")} | {"truth": image(2, 1, 16, 24)}
    about = about | {"iteration": iteration}
    result.case("loss", lambda **_: {}, inputs, training, "", about, ("truth", "clean", "still"), loss)
    return result


FILES: dict[str, Callable[[], File]] = {
    "emvd": emvd_file,
    "spk2imgnet": spk2imgnet_file,
    "memdeblur": memdeblur_file,
    "memdeblur_training": memdeblur_training_file,
    "student_teacher": student_teacher_file,
}


def weight_files() -> None:
    """EMVD's weights as they are found: in a checkpoint, of several devices, in half precision, turned, with code."""
    net = emvd.Emvd(width=4)
    fill(net, "", torch.float32)
    state = net.state_dict()
    folder = OUT / "learned/files"
    torch.save({"iter": 300, "best_psnr": 20.0, "state_dict": state, "optimizer": {"state": {}}}, folder / "wrapped.pth")
    torch.save({f"module.{name}": value for name, value in state.items()}, folder / "module.pth")
    torch.save({name: value.half() for name, value in state.items()}, folder / "half.pth")
    turned = {name: value.transpose(0, 1).contiguous().transpose(0, 1) for name, value in state.items() if value.dim() > 1}
    torch.save(state | turned, folder / "turned.pth", _use_new_zipfile_serialization=False)
    for path in folder.glob("*.pth"):
        path.chmod(0o644)


def main() -> None:
    torch.set_num_threads(1)
    for name in sys.argv[1:] or FILES:
        FILES[name]().save()
    if not sys.argv[1:]:
        weight_files()


if __name__ == "__main__":
    main()
