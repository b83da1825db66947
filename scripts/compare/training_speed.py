"""Compares a training step of the window network with the same network in PyTorch, alternating.

    python scripts/compare/training_speed.py --qudi target/release/qudi --pack pack.zip
    python scripts/compare/training_speed.py --qudi ... --pack ... --device libtorch:0 --torch cuda --batch 64

Needs PyTorch. PyTorch's network refines no flow and merges no predictions; the program does both. Both sides
take whole steps in bfloat16: forward, losses, backward, an optimizer with momentum and Muon's products.
PyTorch's samples are noise that lies ready; the program draws its own. Prints samples a second of every
round, medians, and the ratio of times (below 1: the program is faster).
"""

import argparse
import json
import statistics
import subprocess
import time

import torch
import torch.nn.functional as F
from torch import nn

WIDTHS, FLOW, STATE, CELL_BLOCKS = [64, 96, 128], [32, 64, 64], 64, 2
SENSOR, EMBEDDING, COMPARED, HANDED_UP = 11, 16, 24, 32


class Stack(nn.Module):
    """Entry convolution with ReLU, then residual blocks."""

    def __init__(self, inputs, features, blocks=1):
        super().__init__()
        self.entry = nn.Conv2d(inputs, features, 3, padding=1)
        conv = lambda: nn.Conv2d(features, features, 3, padding=1)
        self.blocks = nn.ModuleList(nn.ModuleList([conv(), conv()]) for _ in range(blocks))

    def forward(self, *inputs):
        x = F.relu(self.entry(torch.cat(inputs, 1)))
        for first, second in self.blocks:
            x = x + second(F.relu(first(x)))
        return x


class Hourglass(nn.Module):
    """Residual stacks from fine to coarse and back."""

    def __init__(self, inputs, conditions):
        super().__init__()
        sizes = [inputs] + [width + conditions for width in WIDTHS[:2]]
        self.encoder = nn.ModuleList(Stack(i, w) for i, w in zip(sizes, WIDTHS))
        self.up = nn.ModuleList(nn.Conv2d(WIDTHS[k + 1], 4 * HANDED_UP, 1) for k in range(2))
        self.decoder = nn.ModuleList(Stack(WIDTHS[k] + HANDED_UP, WIDTHS[k]) for k in range(2))

    def forward(self, inputs, conditions=None):
        levels = [self.encoder[0](*inputs)]
        for encoder in list(self.encoder)[1:]:
            pooled = [F.avg_pool2d(levels[-1], 2)]
            if conditions is not None:
                pooled.append(conditions.expand(-1, -1, *pooled[0].shape[2:]))
            levels.append(encoder(*pooled))
        for k in (1, 0):
            levels[k] = self.decoder[k](levels[k], F.pixel_shuffle(self.up[k](levels[k + 1]), 2))
        return levels


def normalized(x):
    x = x.float()
    return x / (x.square().mean(1, keepdim=True) + 0.05).sqrt()


def warp(x, flow):
    x, flow = x.float(), flow.float()
    _, _, h, w = x.shape
    column = torch.arange(w, device=x.device).view(1, 1, w)
    row = torch.arange(h, device=x.device).view(1, h, 1)
    grid = torch.stack([(flow[:, 0] + column) * 2 / (w - 1) - 1, (flow[:, 1] + row) * 2 / (h - 1) - 1], 3)
    return F.grid_sample(x, grid, padding_mode="border", align_corners=True)


def soft_match(reference, neighbour, radius):
    pairs, _, h, w = reference.shape
    side = 2 * radius + 1
    padded = F.pad(neighbour, [radius] * 4, mode="replicate")
    candidates = F.unfold(padded, side).view(pairs, side * side, h, w)
    squares = F.pad((candidates - reference).square(), [4] * 4, mode="replicate")
    difference = F.avg_pool2d(squares, 9, 1)
    floor = difference.mean(1, keepdim=True) * 0.15 + 0.008
    axis = torch.arange(side, device=reference.device) - float(radius)
    x, y = axis.repeat(side).view(1, -1, 1, 1), axis.repeat_interleave(side).view(1, -1, 1, 1)
    weights = (difference * -20 / floor - x.square() - y.square()).softmax(1)
    return torch.cat([(weights * x).sum(1, keepdim=True), (weights * y).sum(1, keepdim=True)], 1)


class Window(nn.Module):
    """The network of the recipe `window`."""

    def __init__(self):
        super().__init__()
        self.pre, self.pre_head = Hourglass(8 + SENSOR, 0), nn.Conv2d(WIDTHS[0] // 4, 1, 3, padding=1)
        self.compared = nn.ModuleList(nn.Conv2d(width, COMPARED, 1) for width in WIDTHS)
        self.flow = nn.ModuleList(Stack(2 * COMPARED + 5, width) for width in FLOW)
        self.flow_out = nn.ModuleList(nn.Conv2d(width, 2, 3, padding=1) for width in FLOW)
        self.gate = nn.Conv2d(WIDTHS[0] + 8, 32, 3, padding=1)
        self.gate_out = nn.Conv2d(32, 4, 3, padding=1)
        inputs = WIDTHS[0] + STATE + 16 + 8
        self.backward_cell = Stack(inputs, STATE, CELL_BLOCKS)
        self.forward_cell = Stack(inputs + STATE, STATE, CELL_BLOCKS)
        self.enter, self.leave = nn.Linear(SENSOR + 6, 64), nn.Linear(64, EMBEDDING)
        self.unet = Hourglass(WIDTHS[0] + 2 * STATE + 12 + EMBEDDING + 8, EMBEDDING)
        self.unet_head = nn.Conv2d(WIDTHS[0] // 4, 1, 3, padding=1)

    def pairs(self, x, frames):
        x = x.view(-1, frames, *x.shape[1:])
        early, late = (x[:, k : k + frames - 1].flatten(0, 1) for k in (0, 1))
        return torch.cat([early, late]), torch.cat([late, early])

    def flows(self, restored, features, frames):
        images = [F.avg_pool2d(restored.detach().float(), 2)]
        for _ in range(2):
            images.append(F.avg_pool2d(images[-1], 2))
        flow, found = None, []
        for level in (2, 1, 0):
            reference, neighbour = self.pairs(images[level], frames)
            compared, other = self.pairs(normalized(self.compared[level](features[level])), frames)
            if flow is None:
                flow = torch.zeros(len(reference), 2, *reference.shape[2:], device=reference.device)
            else:
                flow = F.interpolate(flow, scale_factor=2, mode="bilinear") * 2
            if level:
                with torch.no_grad():
                    near = warp(neighbour, flow)
                    match = soft_match(reference, near, (0, 3, 4)[level])
                flow = flow + match
            warped = warp(torch.cat([other, neighbour], 1), flow)
            difference = (warped[:, COMPARED:] - reference) * 8
            inputs = [compared, warped[:, :COMPARED], difference, difference.abs(), reference * 2 - 1, flow.detach() / 4]
            flow = flow + self.flow_out[level](self.flow[level](*inputs)).float()
            found.append(flow)
        return found[::-1]

    def fuse(self, restored, linear, features, flow, frames):
        by_frame = lambda x: x.view(-1, frames, *x.shape[1:]).unbind(1)
        folded = torch.cat([F.pixel_unshuffle(restored, 2), F.pixel_unshuffle(linear, 2)], 1)
        own, features = by_frame(folded), by_frame(features)
        whole, seen = by_frame(linear), by_frame(restored)
        flow = flow.detach()
        half = len(flow) // 2
        along = [part.view(-1, frames - 1, *part.shape[1:]) for part in (flow[:half], flow[half:])]
        wide = F.interpolate(flow, scale_factor=2, mode="bilinear") * 2
        along_wide = [part.view(-1, frames - 1, *part.shape[1:]) for part in (wide[:half], wide[half:])]

        def run(cell, order, more):
            states, merged, last = {}, {}, None
            for frame in order:
                image = own[frame]
                if last is None:
                    hidden, difference = torch.zeros_like(features[frame][:, :STATE]), torch.zeros_like(image)
                    mean, count = whole[frame], torch.ones_like(whole[frame])
                else:
                    next_one = last > frame
                    at = frame if next_one else frame - 1
                    both = warp(torch.cat([states[last], own[last]], 1), along[1 - next_one][:, at])
                    hidden, difference = both[:, :STATE], (both[:, STATE:] - image) * 8
                    both = warp(torch.cat(merged[last], 1), along_wide[1 - next_one][:, at])
                    mean, count = both[:, :1], both[:, 1:]
                    apart = F.pixel_unshuffle((mean - seen[frame]) * 3, 2)
                    inputs = torch.cat([features[frame], apart, F.pixel_unshuffle(count.log(), 2)], 1)
                    gate = F.pixel_shuffle(self.gate_out(F.relu(self.gate(inputs))).float() + 1.5, 2).sigmoid()
                    used = gate * count
                    mean, count = (mean * used + whole[frame]) / (used + 1), used + 1
                planes = torch.cat([F.pixel_unshuffle((mean - 0.45) * 3, 2), F.pixel_unshuffle(count.log(), 2)], 1)
                images = [(image[:, :4] - 0.45) * 3, (image[:, 4:] - image[:, :4]) * 3, difference]
                inputs = [features[frame], hidden, *images, *([more[frame]] if more else []), planes]
                states[frame], merged[frame], last = normalized(cell(*inputs)), (mean, count), frame
            return states, merged

        later, after = run(self.backward_cell, range(frames - 1, -1, -1), None)
        earlier, before = run(self.forward_cell, range(frames), later)
        all_of = lambda x: torch.stack([x[k] for k in range(frames)], 1).flatten(0, 1)
        parts = [tuple(torch.stack([x[k][i] for k in range(frames)], 1).flatten(0, 1) for i in (0, 1)) for x in (before, after)]
        count = parts[0][1] + parts[1][1] - 1
        mean = (parts[0][0] * parts[0][1] + parts[1][0] * parts[1][1] - linear) / count
        return all_of(earlier), all_of(later), mean, count

    def forward(self, linear, counts, sensor, truth, noise, frames):
        planes = torch.cat([F.pixel_unshuffle((linear - 0.45) * 2, 2), F.pixel_unshuffle(counts * 2 - 1, 2)], 1)
        pyramid = self.pre([planes, sensor.expand(-1, -1, *planes.shape[2:])])
        local = F.interpolate(F.avg_pool2d(linear, 8), scale_factor=8, mode="bilinear")
        restored = self.pre_head(F.pixel_shuffle(pyramid[0], 2)).float() + local
        flows = self.flows(restored, pyramid, frames)
        features = normalized(pyramid[0])
        earlier, later, mean, count = self.fuse(restored, linear, features, flows[0], frames)
        step = torch.cat([sensor.flatten(1), sensor.flatten(1)[:, :6]], 1)
        embedding = self.leave(F.silu(self.enter(step)))[:, :, None, None]
        noisy = F.pixel_unshuffle((truth * 2 - 1 + noise - restored).clamp(-6, 6), 2)
        merged = torch.cat([F.pixel_unshuffle((mean - 0.45) * 3, 2), F.pixel_unshuffle(count.log(), 2)], 1)
        inputs = [features, earlier, later, F.pixel_unshuffle((restored - 0.45) * 3, 2), noisy, torch.zeros_like(noisy)]
        inputs += [embedding.expand(-1, -1, *noisy.shape[2:]), merged]
        out = restored + self.unet_head(F.pixel_shuffle(self.unet(inputs, embedding)[0], 2)).float() * 0.1
        log_error = lambda x: ((x - truth).square().mean((1, 2, 3)) + 0.01).log().mean()
        loss = log_error(out) + 0.2 * log_error(restored) + 0.2 * log_error(mean)
        for level, flow in enumerate(flows):
            reference, neighbour = self.pairs(F.avg_pool2d(truth, 2 << level), frames)
            loss = loss + 3 * ((warp(neighbour, flow) - reference).square() + 1e-5).sqrt().mean()
        return loss


def muon_(parameters, momentum, lr):
    groups = {}
    for parameter, mean in zip(parameters, momentum):
        mean.lerp_(parameter.grad, 0.05)
        groups.setdefault(parameter.shape if parameter.dim() > 1 else None, []).append((parameter, mean))
    for shape, members in groups.items():
        if shape is None:
            for parameter, mean in members:
                parameter.sub_(mean, alpha=lr)
            continue
        x = torch.stack([mean.flatten(1) for _, mean in members])
        x = x / (x.flatten(1).norm(dim=1)[:, None, None] + 1e-7)
        tall = x.shape[1] > x.shape[2]
        x = x.mT if tall else x
        for _ in range(5):
            square = x @ x.mT
            x = 3.4445 * x + (-4.7750 * square + 2.0315 * square @ square) @ x
        x = x.mT if tall else x
        for (parameter, _), step in zip(members, x):
            parameter.sub_(step.reshape(shape), alpha=lr)


def torch_rate(device, batch, frames, side, seconds):
    torch.manual_seed(1)
    network = Window().to(device, memory_format=torch.channels_last)
    images = batch * frames
    draw = lambda *shape: torch.rand(*shape, device=device)
    linear, counts, truth = (draw(images, 1, side, side) for _ in range(3))
    sensor, noise = draw(images, SENSOR, 1, 1), torch.randn(images, 1, side, side, device=device)
    parameters = list(network.parameters())
    momentum = [torch.zeros_like(parameter) for parameter in parameters]

    def step():
        with torch.autocast(torch.device(device).type, torch.bfloat16):
            loss = network(linear, counts, sensor, truth, noise, frames)
        network.zero_grad(set_to_none=True)
        loss.backward()
        with torch.no_grad():
            muon_(parameters, momentum, 1e-3)

    def wait():
        if torch.device(device).type == "cuda":
            torch.cuda.synchronize()

    for _ in range(3):
        step()
    wait()
    start, steps = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        step()
        steps += 1
    wait()
    return batch * steps / (time.perf_counter() - start)


def qudi_rate(args):
    command = [args.qudi, "bench", "--train", "window", "--pack", args.pack, "--device", args.device, "--json"]
    command += ["--seconds", str(args.seconds), "--set", f"train.batch={args.batch}"]
    command += ["--set", f"data.frames={args.frames}", "--set", f"data.crop={args.side}"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)["speed"]["samples_per_second"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--qudi", required=True, help="the program")
    parser.add_argument("--pack", required=True, help="decoded data, from `qudi train window --prepare`")
    parser.add_argument("--device", default="cpu", help="the program's device")
    parser.add_argument("--torch", default="cpu", help="PyTorch's device")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--side", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    count = sum(parameter.numel() for parameter in Window().parameters())
    print(f"PyTorch {torch.__version__}: {count} parameters")
    rates = {"qudi": [], "torch": []}
    for number in range(args.rounds):
        rates["qudi"].append(qudi_rate(args))
        rates["torch"].append(torch_rate(args.torch, args.batch, args.frames, args.side, args.seconds))
        print(f"round {number + 1}: qudi {rates['qudi'][-1]:.2f}, PyTorch {rates['torch'][-1]:.2f} samples/s")
    median = {name: statistics.median(values) for name, values in rates.items()}
    print(f"medians: qudi {median['qudi']:.2f}, PyTorch {median['torch']:.2f} samples/s; time over PyTorch's: {median['torch'] / median['qudi']:.2f}")


if __name__ == "__main__":
    main()
