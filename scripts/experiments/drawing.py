# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy", "pillow", "safetensors", "torch"]
# ///
"""Train one small U-Net in three ways to draw texture on the restored mean, and judge what it draws.

    python scripts/convert/lpips.py weights
    python scripts/experiments/drawing.py data path/to/qudi windows --videos *.mp4 --stills *.png
    python scripts/experiments/drawing.py train windows weights lpips.pt lpips --level
    python scripts/experiments/drawing.py train windows weights flow.pt flow --steps 1600 --rate 8e-4
    python scripts/experiments/drawing.py train windows weights adversarial.pt adversarial --level
    python scripts/experiments/drawing.py judge path/to/qudi weights report CLIPS/launch CLIPS/calendar --states *.pt

`data` exposes windows of 11 frames (videos need ffmpeg) and restores them by one step of `qudi-diffusion`:
the mean `d`, after its best gain. `train` learns the truth `x` from single frames of `d`:

- lpips: squared error and LPIPS-VGG; adversarial: and a discriminator of patches of three frames;
- flow: posterior-mean rectified flow (Ohayon et al. 2024) from `d` and noise of half its rms error to `x`.

All see the same samples in the same order and start from the same weights. `judge` restores the middle of
clips, draws on it, and prints figures of `qudi eval` and its own, which it also writes into the folder.
"""

import argparse
import copy
import json
import math
import random
import subprocess
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from safetensors.torch import load_file
from torch import nn
from torch.nn.utils.parametrizations import spectral_norm

FRAMES, SIDE, CROP, TRIPLES = 11, 192, 64, 4
LIGHT, SUFFIX = ["--ppp", "3.25"], "-ppp3_25.npy"
POOLS = {"alexnet": {3, 6}, "vgg16": {5, 10, 17, 24}}
TAPS = {"alexnet": [0, 3, 6, 8, 10], "vgg16": [2, 7, 14, 21, 28]}


def gain(restored: np.ndarray, truth: np.ndarray) -> float:
    """Return the factor that brings `restored` closest to `truth`."""
    return float((restored * truth).sum() / (restored * restored).sum())


def run(command: list) -> bytes:
    """Run a command, and return what it prints."""
    return subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout


def moving_still(path: Path, rng: random.Random) -> np.ndarray:
    """Return frames of a still that is shrunk by up to 2, zooms, and moves by 0 to 4 pixels a frame."""
    image, last = Image.open(path).convert("L"), FRAMES - 1
    scale = min(rng.uniform(1.25, 2.0), min(image.size) / (SIDE + 8))
    side = SIDE * scale
    room = [(length - side) / last for length in image.size]
    angle, speed = rng.uniform(0, math.tau), rng.uniform(0, 4) * scale
    step = [max(-r, min(r, speed * f(angle))) for r, f in zip(room, (math.cos, math.sin))]
    zoom = rng.uniform(-0.002, 0.002)
    start = [rng.uniform(max(0, -s) * last, (r - max(0, s)) * last) for s, r in zip(step, room)]
    frames = []
    for i in range(FRAMES):
        now = side * (1 + zoom * (i - 5))
        box = [max(0.0, min(a + i * s, n - now)) for a, s, n in zip(start, step, image.size)]
        ends = [min(b + now, n) for b, n in zip(box, image.size)]
        frames.append(np.asarray(image.resize((SIDE, SIDE), Image.Resampling.BICUBIC, (*box, *ends))))
    return np.stack(frames)


def clip_window(path: Path, rng: random.Random) -> np.ndarray:
    """Return frames of a video, shrunk by 1 to 1.5, from a random place and time."""
    probe = ["ffprobe", "-v", "error", "-select_streams", "v", "-of", "csv=p=0", "-show_entries"]
    text = run([*probe, "stream=width,height,nb_frames", path])
    width, height, count = (int(part) for part in text.decode().split(","))
    scale = min(rng.uniform(1.0, 1.5), min(width, height) / SIDE)
    wide, high = (max(SIDE, round(length / scale)) for length in (width, height))
    first = rng.randrange(count - FRAMES + 1)
    x, y = rng.randrange(wide - SIDE + 1), rng.randrange(high - SIDE + 1)
    taken = f"select=gte(n\\,{first}),scale={wide}:{high}:flags=area,crop={SIDE}:{SIDE}:{x}:{y},format=gray"
    command = ["ffmpeg", "-v", "error", "-i", path, "-vf", taken, "-frames:v", str(FRAMES)]
    return np.frombuffer(run([*command, "-f", "rawvideo", "-"]), np.uint8).reshape(FRAMES, SIDE, SIDE)


def restore(qudi: Path, counts: Path, output: Path) -> np.ndarray:
    """Return the mean that one step of `qudi-diffusion` makes of counts."""
    settings = ["--method", "qudi-diffusion", "--steps", "1", "-q", "-f", "-j", "1", "--device", "cpu"]
    run([qudi, "restore", counts, "-o", output, *settings])
    return np.load(output).astype(np.float32)


def make_window(args: argparse.Namespace, number: int, kind: str, path: Path) -> None:
    """Write one window: the mean after its best gain, and the truth."""
    frames = (clip_window if kind == "video" else moving_still)(path, random.Random(number))
    with tempfile.TemporaryDirectory() as scratch:
        scene, counts, result = (Path(scratch) / f"{name}.npy" for name in ("scene", "counts", "result"))
        np.save(scene, frames)
        run([args.qudi, "simulate", scene, *LIGHT, "--seed", str(number), "-o", counts, "-q"])
        mean = restore(args.qudi, counts, result)
    mean *= gain(mean, frames.astype(np.float32) / 255)
    np.savez(args.windows / f"{number:04}.npz", mean=mean.astype(np.float16), truth=frames)


def make_data(args: argparse.Namespace) -> None:
    """Make windows of all videos and stills, in an order of chance, so that it can stop at any time."""
    args.windows.mkdir(parents=True, exist_ok=True)
    plan = [("video", path) for path in args.videos for _ in range(3)]
    plan += [("still", path) for path in args.stills]
    random.Random(0).shuffle(plan)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda job: make_window(args, job[0], *job[1]), enumerate(plan)))


def unit(x: torch.Tensor) -> torch.Tensor:
    """Scale the channels of every pixel to a mean square of one; without it, features grew without end."""
    return x * (x.float().square().mean(1, keepdim=True) + 1e-4).rsqrt().to(x.dtype)


class Block(nn.Module):
    """Add two convolutions of the input to it; the time scales and shifts the first's output."""

    def __init__(self, channels: int, level: bool) -> None:
        super().__init__()
        self.level = level
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)
        self.time = nn.Linear(64, 2 * channels)

    def forward(self, x: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        scale, shift = self.time(time)[:, :, None, None].chunk(2, 1)
        return x + self.second(F.silu(self.first(unit(x) if self.level else x) * (1 + scale) + shift))


class Net(nn.Module):
    """Predict with a U-Net of three scales from half the resolution on; the last layer has the full one."""

    def __init__(self, level: bool) -> None:
        super().__init__()
        self.level = level
        a, b, c = 48, 96, 192
        self.start = nn.Conv2d(8, a, 3, padding=1)
        self.time = nn.Sequential(nn.Linear(16, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU())
        self.blocks = nn.ModuleList(Block(n, level) for n in (a, a, b, b, c, c, b, b, a, a))
        self.down = nn.ModuleList(nn.Conv2d(m, n, 3, 2, 1) for m, n in ((a, b), (b, c)))
        self.up = nn.ModuleList(nn.Conv2d(m, n, 3, padding=1) for m, n in ((c, b), (b, a)))
        self.full = nn.Conv2d(a, 64, 3, padding=1)
        self.last = nn.Conv2d(16, 1, 3, padding=1)
        for layer in (self.last, *(block.second for block in self.blocks)):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, mean: torch.Tensor, moved: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        waves = t[:, None] * torch.arange(1, 9) * (math.pi / 2)
        time = self.time(torch.cat([waves.sin(), waves.cos()], 1))
        x = self.start(F.pixel_unshuffle(torch.cat([(mean - 0.5) * 4, moved], 1), 2))
        kept = []
        for i, block in enumerate(self.blocks):
            if i in (2, 4):
                kept.append(x)
                x = self.down[i // 2 - 1](x)
            if i in (6, 8):
                x = kept.pop() + self.up[i // 2 - 3](F.interpolate(x, scale_factor=2.0))
            x = block(x, time)
        return self.last(F.silu(F.pixel_shuffle(self.full(unit(x) if self.level else x), 2))).float()


class Judge(nn.Sequential):
    """Tell patches of three drawn frames from patches of true ones."""

    def __init__(self) -> None:
        layers: list[nn.Module] = []
        for m, n, stride in ((3, 32, 1), (32, 64, 2), (64, 96, 2), (96, 128, 2)):
            layers += [spectral_norm(nn.Conv2d(m, n, 3 if stride == 1 else 4, stride, 1)), nn.LeakyReLU(0.2)]
        super().__init__(*layers, spectral_norm(nn.Conv2d(128, 1, 3, padding=1)))

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        return super().forward((frames.reshape(-1, 3, *frames.shape[2:]) - 0.5) * 4).float()


def features(net: str, weights: dict[str, torch.Tensor], x: torch.Tensor) -> list[torch.Tensor]:
    """Return the features of gray images in [0, 1] that LPIPS compares."""
    shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
    x = ((x * 2 - 1 - shift) / scale).contiguous(memory_format=torch.channels_last)
    taken = []
    for place in sorted({int(name.split(".")[1]) for name in weights if name.startswith("features")}):
        if place in POOLS[net]:
            x = F.max_pool2d(x, 3 if net == "alexnet" else 2, 2)
        weight, bias = (weights[f"features.{place}.{kind}"] for kind in ("weight", "bias"))
        first = net == "alexnet" and place == 0
        x = F.relu(F.conv2d(x, weight, bias, 4 if first else 1, 2 if first else weight.shape[2] // 2))
        if place in TAPS[net]:
            taken.append(x)
    return taken


def distance(weights: dict, drawn: list[torch.Tensor], truth: list[torch.Tensor]) -> torch.Tensor:
    """Return LPIPS 0.1 (Zhang et al. 2018), the mean over images whose features are given."""
    total = torch.zeros(())
    for tap, pair in enumerate(zip(drawn, truth)):
        a, b = (f.float() / (f.float().square().sum(1, keepdim=True) + 1e-10).sqrt() for f in pair)
        head = weights[f"lin{tap}.model.1.weight"].flatten()
        total = total + ((a - b).square().mean((0, 2, 3)) * head).sum()
    return total


class Windows:
    """Draw samples of three consecutive frames of random windows, turned at random."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.pairs = [(*np.load(path).values(),) for path in sorted(folder.glob("*.npz"))]
        self.rng = np.random.default_rng(seed)
        self.sigma = rms(np.stack([m.astype(np.float32) - t / np.float32(255) for m, t in self.pairs]))

    def batch(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return means and truths, each (3 frames of every window, 1, height, width)."""
        taken = []
        for n in self.rng.integers(len(self.pairs), size=TRIPLES):
            first, y, x = (self.rng.integers(high) for high in (FRAMES - 2, SIDE - CROP + 1, SIDE - CROP + 1))
            pair = [part[first : first + 3, y : y + CROP, x : x + CROP] for part in self.pairs[n]]
            flip, turn = self.rng.integers(2), self.rng.integers(4)
            taken.append([np.rot90(part[:, :, ::-1] if flip else part, turn, (1, 2)) for part in pair])
        mean, truth = (np.concatenate(parts)[:, None].astype(np.float32) for parts in zip(*taken))
        return torch.from_numpy(mean), torch.from_numpy(truth / 255)


def train(args: argparse.Namespace) -> None:
    """Train in one of the three ways, and write the averaged weights."""
    torch.manual_seed(args.seed)
    data = Windows(args.windows, args.seed)
    net = Net(args.level).to(memory_format=torch.channels_last)
    shown = copy.deepcopy(net)
    vgg = load_file(args.backbones / "vgg16.safetensors")
    judge = Judge().to(memory_format=torch.channels_last)
    sigma, noise = data.sigma, torch.Generator().manual_seed(args.seed)
    optimizer = torch.optim.AdamW(net.parameters(), args.rate, (0.9, 0.99), weight_decay=1e-4)
    against = torch.optim.Adam(judge.parameters(), 4e-4, (0.0, 0.99))
    print(f"{len(data.pairs)} windows, sigma {sigma:.4f}, {sum(p.numel() for p in net.parameters())} weights")
    began, sums = time.monotonic(), {}
    for step in range(args.steps):
        falling = 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / args.steps))
        optimizer.param_groups[0]["lr"] = args.rate * falling * min(1.0, (step + 1) / 100)
        mean, truth = data.batch()
        with torch.autocast("cpu", torch.bfloat16):
            if args.way == "flow":
                start = 0.5 * torch.randn(mean.shape, generator=noise)
                t = torch.rand(len(mean), generator=noise)
                end = (truth - mean) / sigma
                moved = start + t[:, None, None, None] * (end - start)
                loss = (net(mean, moved, t) - (end - start)).square().mean()
                loss.backward()
                scores = {"loss": loss}
            else:
                out = mean + sigma * net(mean, torch.zeros_like(mean), torch.zeros(len(mean)))
                leaf = out.detach().requires_grad_()
                squared = (leaf - truth).square().mean() / sigma**2
                # One frame in three, because VGG16 is slow.
                far = distance(vgg, *(features("vgg16", vgg, side[::3]) for side in (leaf, truth)))
                (pull,) = torch.autograd.grad(squared + args.perceptual * far, leaf)
                scores = {"squared": squared, "lpips": far}
                if args.way == "adversarial":
                    worse = F.relu(1 - judge(truth)).mean() + F.relu(1 + judge(leaf.detach())).mean()
                    against.zero_grad()
                    worse.backward()
                    against.step()
                    (push,) = torch.autograd.grad(-judge(leaf).mean(), leaf)
                    share = args.share * min(1.0, max(0.0, step / args.steps * 5 - 0.5))
                    most = (leaf.detach() - truth).norm() * 2 / sigma**2 / leaf.numel()
                    pull = pull + push * (share * most / (push.norm() + 1e-12))
                    scores["discriminator"] = worse
                out.backward(pull)
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        with torch.no_grad():
            for old, new in zip(shown.parameters(), net.parameters()):
                old.lerp_(new, 1 - min(0.995, (step + 1) / (step + 10)))
        sums = {name: sums.get(name, 0.0) + value.item() for name, value in scores.items()}
        if (step + 1) % 100 == 0 or step + 1 == args.steps:
            minutes = (time.monotonic() - began) / 60
            print(step + 1, f"{minutes:.1f} min", {k: round(v / 100, 4) for k, v in sums.items()}, flush=True)
            sums = {}
            kept = {"way": args.way, "sigma": sigma, "level": args.level, "net": shown.state_dict()}
            torch.save(kept, args.state)


@torch.no_grad()
def draw(state: dict, mean: np.ndarray, seed: int, steps: int, same: bool = False) -> np.ndarray:
    """Return frames that a trained network makes of the mean; `same` takes the same noise for all."""
    net = Net(state["level"])
    net.load_state_dict(state["net"])
    d, noise = torch.from_numpy(mean)[:, None], torch.Generator().manual_seed(seed)
    draws = 0.5 * torch.randn((1 if same else len(d), *d.shape[1:]), generator=noise)
    moved = torch.zeros_like(d) + (draws if state["way"] == "flow" else 0)
    with torch.autocast("cpu", torch.bfloat16):
        for i in range(steps):
            moved = moved + net(d, moved, torch.full((len(d),), i / steps)) / steps
    return (d + state["sigma"] * moved)[:, 0].clip(0, 1).numpy()


@torch.no_grad()
def seen(net: str, weights: dict, frames: np.ndarray) -> list[torch.Tensor]:
    """Return the features of frames: of every second one in 16 bits for VGG16, which is slow."""
    images = torch.from_numpy(frames[:: 2 if net == "vgg16" else 1])[:, None].split(4)
    with torch.autocast("cpu", torch.bfloat16, enabled=net == "vgg16"):
        parts = [features(net, weights, part) for part in images]
    return [torch.cat(taps) for taps in zip(*parts)]


def frechet(drawn: list[torch.Tensor], truth: list[torch.Tensor]) -> float:
    """Return the Fréchet distance of mean features of fields of 64 x 64 pixels, 32 pixels apart."""
    moments = []
    for f in (torch.cat(drawn), torch.cat(truth)):
        f = f.flatten(2).permute(0, 2, 1).flatten(0, 1).double()
        moments.append((f.mean(0), torch.cov(f.T)))
    (m, a), (n, b) = moments
    roots = torch.linalg.eigvals(a @ b).real.clamp(min=0).sqrt().sum()
    return float((m - n).square().sum() + a.trace() + b.trace() - 2 * roots)


def fields(net: str, taps: list[torch.Tensor]) -> torch.Tensor:
    """Return means of the third tap over fields of 64 x 64 pixels."""
    return F.avg_pool2d(taps[2].float(), *((4, 2) if net == "alexnet" else (16, 8)))


def nyquist(frames: np.ndarray) -> float:
    """Return the power where a frequency along x or y is above 0.47 cycles a pixel."""
    side = frames.shape[1]
    window = np.hanning(side)[:, None] * np.hanning(side)
    power = np.abs(np.fft.fft2((frames - frames.mean((1, 2), keepdims=True)) * window)) ** 2
    high = np.abs(np.fft.fftfreq(side)) > 0.47
    return float(power[:, high[:, None] | high[None]].sum())


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.square(values).mean()))


def evaluate(args: argparse.Namespace, *more: str) -> dict[str, list[dict]]:
    """Return the figures of `qudi eval` by method and clip."""
    settings = [*LIGHT, "--frames", str(FRAMES), "--seed", "2", "--method", "average", "--json", "-q"]
    rows = json.loads(run([args.qudi, "eval", args.work / "clips", *settings, *more]))["rows"]
    return {row["method"]: row["clips"] for row in rows}


def middle(clip: Path, folder: Path) -> np.ndarray:
    """Return the middle of the frames of a clip, and write it as a clip."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for path in sorted(clip.iterdir())[:FRAMES]:
        image = Image.open(path).convert("L")
        x, y = ((length - 256) // 2 for length in image.size)
        image = image.crop((x, y, x + 256, y + 256))
        image.save(folder / path.with_suffix(".png").name)
        frames.append(np.asarray(image))
    return np.stack(frames).astype(np.float32) / 255


def judge(args: argparse.Namespace) -> None:
    """Restore clips, draw on them with all states, and print all figures, means over clips."""
    photons = args.work / "photons"
    truth = {clip.name: middle(clip, args.work / "clips" / clip.name) for clip in args.clips}
    if not photons.exists():
        evaluate(args, "--export-photons", str(photons))
    mean = {}
    for clip, x in truth.items():
        kept = args.work / f"mean-{clip}.npy"
        d = np.load(kept) if kept.exists() else restore(args.qudi, photons / f"{clip}{SUFFIX}", kept)
        mean[clip] = d * gain(d, x)
    drawn = {"mean": mean}
    for path in args.states:
        state, stem = torch.load(path), path.stem
        ways = {"": (0, 1, False)}
        if state["way"] == "flow":
            ways = {"": (0, 5, False), "-again": (1, 5, False), "-1": (0, 1, False), "-same": (0, 5, True)}
        for name, (seed, steps, same) in ways.items():
            numbered = enumerate(mean.items())
            drawn[stem + name] = {c: draw(state, d, seed + 100 * i, steps, same) for i, (c, d) in numbered}
    rng = np.random.default_rng(1)
    for size in args.grain:
        noisy = {clip: d + size * rng.standard_normal(d.shape) for clip, d in mean.items()}
        drawn[f"grain-{size}"] = {c: y.clip(0, 1).astype(np.float32) for c, y in noisy.items()}
    for name, frames in drawn.items():
        (args.work / name).mkdir(exist_ok=True)
        for clip, values in frames.items():
            np.save(args.work / name / f"{clip}{SUFFIX}", values.clip(0, 1))
    rows = evaluate(args, *(word for n in drawn for word in ("--external", f"{n}={args.work / n}")))
    nets = {net: load_file(args.backbones / f"{net}.safetensors") for net in POOLS}
    true = {(net, clip): seen(net, weights, x) for net, weights in nets.items() for clip, x in truth.items()}
    table = {}
    for name, frames in drawn.items():
        parts, drawn_fields = {}, {net: [] for net in nets}
        for scores in rows[name]:
            clip = scores["clip"]
            d, x, y = (side[clip] for side in (mean, truth, frames))
            part = {key: float(np.mean([f[key] for f in scores["frames"]])) for key in ("psnr_a", "ssim")}
            part |= {"flicker": scores["flicker"], "added": rms(y - d) / rms(d - x)}
            part["nyquist"] = nyquist(y) / nyquist(x)
            if f"{name}-again" in drawn:
                part["spread"] = rms(y - drawn[f"{name}-again"][clip]) / math.sqrt(2) / rms(d - x)
            best = np.stack([p * gain(p, q) for p, q in zip(y, x)]).clip(0, 1)
            for net, weights in nets.items():
                taps = seen(net, weights, best)
                part[f"lpips_{net}"] = distance(weights, taps, true[net, clip]).item()
                drawn_fields[net].append(fields(net, taps))
            parts[clip] = part
        row = {key: float(np.mean([part[key] for part in parts.values()])) for key in part}
        for net in nets:
            row[f"frechet_{net}"] = frechet(drawn_fields[net], [fields(net, true[net, c]) for c in parts])
        table[name] = row | {"clips": parts}
        print(name, {key: round(value, 4) for key, value in row.items()}, flush=True)
        (args.work / "figures.json").write_text(json.dumps(table, indent=1))


def main() -> None:
    """Run the part that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parts = parser.add_subparsers(dest="part", required=True)
    places = {"data": "qudi windows", "train": "windows backbones state", "judge": "qudi backbones work"}
    made = {name: parts.add_parser(name) for name in places}
    for name, part in made.items():
        for place in places[name].split():
            part.add_argument(place, type=Path)
    made["train"].add_argument("way", choices=["lpips", "flow", "adversarial"])
    made["data"].add_argument("--videos", type=Path, nargs="*", default=[])
    made["data"].add_argument("--stills", type=Path, nargs="*", default=[])
    made["train"].add_argument("--steps", type=int, default=1000)
    made["train"].add_argument("--rate", type=float, default=6e-4)
    made["train"].add_argument("--perceptual", type=float, default=116, help="weight of LPIPS-VGG")
    made["train"].add_argument("--share", type=float, default=0.5, help="discriminator's gradient over L2's")
    made["train"].add_argument("--level", action="store_true", help="scale the channels of every pixel")
    made["train"].add_argument("--seed", type=int, default=1)
    made["judge"].add_argument("clips", type=Path, nargs="+")
    made["judge"].add_argument("--grain", type=float, nargs="*", default=[], help="white noise to compare")
    made["judge"].add_argument("--states", type=Path, nargs="+", default=[])
    args = parser.parse_args()
    torch.set_num_threads(1)
    {"data": make_data, "train": train, "judge": judge}[args.part](args)


if __name__ == "__main__":
    main()
