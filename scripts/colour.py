#!/usr/bin/env python3
"""Compares restored colours of photographs in motion behind a colour filter: QuDi, what is known, and bounds.

    python3 scripts/colour.py QUDI FOLDER [--ppp 3.25,9.75] [--pictures 1,5] [--cfa rggb | --rgbw] [--size HxW]

Needs NumPy. Every picture moves by 0.7 and -0.45 pixels a frame for 11 frames, in linear light, and is exposed
behind the filter with the sensor of `qudi simulate`. The middle frame is scored after one common gain.

    average     the mean of 11 frames, demosaiced bilinearly
    each        every frame demosaiced bilinearly, its three planes restored apart
    apart       the four planes of a Bayer filter restored apart, interpolated bilinearly
    qudi        `qudi restore`
    full        three full planes of the same light each, restored apart: the ceiling
    together    these planes as one capture, restored together
    luma        luma of `qudi restore`, and the gray restoration of luma through the same light
"""

import argparse
import json
import pathlib
import struct
import subprocess
import tempfile
import time
import zlib

import numpy as np

MIDDLE = 5

# Shares of red, green, blue and white pixels of a fixed random filter.
RGBW = {"r": 0.0807, "g": 0.0807, "b": 0.0807, "w": 0.7579}


def psnr(estimate, truth, border=4):
    """PSNR of the inner part after the best gain."""
    inside = (slice(border, -border), slice(border, -border))
    estimate, truth = estimate[inside].astype(float), truth[inside].astype(float)
    gain = (estimate * truth).sum() / max((estimate * estimate).sum(), 1e-12)
    error = np.clip(gain * estimate, 0, 1) - np.clip(truth, 0, 1)
    return float(-10 * np.log10((error**2).mean()))


def interpolated(plane, row, column, size):
    """Bilinear interpolation of every second pixel, from a row and a column on."""
    height, width = size
    y = np.clip((np.arange(height) - row) / 2, 0, plane.shape[0] - 1)
    x = np.clip((np.arange(width) - column) / 2, 0, plane.shape[1] - 1)
    y0, x0 = np.floor(y).astype(int), np.floor(x).astype(int)
    y1, x1 = np.minimum(y0 + 1, plane.shape[0] - 1), np.minimum(x0 + 1, plane.shape[1] - 1)
    fy, fx = (y - y0)[:, None], (x - x0)[None]
    upper = plane[y0][:, x0] * (1 - fx) + plane[y0][:, x1] * fx
    lower = plane[y1][:, x0] * (1 - fx) + plane[y1][:, x1] * fx
    return upper * (1 - fy) + lower * fy


def demosaiced(planes, letters, size):
    """Returns red, green and blue from the planes of a tile; planes of one colour are averaged."""
    of = {c: [] for c in "rgb"}
    for k, letter in enumerate(letters):
        of[letter].append(interpolated(planes[k], k // 2, k % 2, size))
    return np.stack([np.mean(of[c], 0) for c in "rgb"], -1)


def rgbw_filter(size):
    """A random filter, the same in every run: pure colours for `--cfa FILE.png`."""
    colours = {"r": (255, 0, 0), "g": (0, 255, 0), "b": (0, 0, 255), "w": (255, 255, 255)}
    shares = np.array(list(RGBW.values()))
    drawn = np.random.default_rng(61).choice(4, size, p=shares / shares.sum())
    return np.array(list(colours.values()), np.uint8)[drawn]


def luma_weights(pixels):
    """Weights of red, green and blue in the mean of what the pixels of a filter see."""
    share = [float((pixels == np.array(c)).all(-1).mean()) for c in ((255, 0, 0), (0, 255, 0), (0, 0, 255))]
    return np.array(share) + (1 - sum(share)) / 3


def best_gain(planes, truth):
    return (planes * truth).sum() / max((planes * planes).sum(), 1e-12)


def shown(planes, gain):
    """8-bit sRGB of linear light."""
    light = np.clip(gain * planes, 0, 1)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * curve + 0.5).astype(np.uint8)


def write_png(path, pixels):
    """Writes an 8-bit RGB PNG."""
    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b"")]
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n")
        for name, data in chunks:
            file.write(struct.pack(">I", len(data)) + name + data)
            file.write(struct.pack(">I", zlib.crc32(name + data)))


class Runner:
    def __init__(self, qudi, folder, arguments):
        self.qudi, self.folder, self.arguments = qudi, folder, arguments

    def run(self, *words):
        command = [self.qudi, *map(str, words)]
        done = subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
        return done.stdout

    def restored(self, capture, name, *words):
        start = time.time()
        self.run("restore", capture, "-o", name, "--force", "--mask", "none", *words)
        return np.load(self.folder / name), time.time() - start

    def luma(self, cfa, picture, size):
        """Writes the filter, if it is random, and returns the weights of luma."""
        if not self.arguments.rgbw:
            tile = cfa.split("@")[0]
            return np.array([tile.count(c) for c in "rgb"]) / len(tile)
        probe = ["simulate", picture, "-o", "size.npy", "--cfa", "rggb", "--force", "--frames", 1, *size]
        self.run(*probe)
        pixels = rgbw_filter(np.load(self.folder / "size.npy").shape[1:])
        write_png(self.folder / cfa, pixels)
        return luma_weights(pixels)

    def scores(self, picture, ppp):
        arguments = self.arguments
        size = ["--size", arguments.size] if arguments.size else []
        cfa = "rgbw.png" if arguments.rgbw else arguments.cfa
        weights = self.luma(cfa, picture, size)
        self.run(
            *["simulate", picture, "-o", "m.npy", "--truth", "t.npy", "--cfa", cfa, "--force"],
            *["--motion", "pan:0.7,-0.45", "--frames", 11, "--ppp", ppp, "--seed", 1, *size],
        )
        truth = np.load(self.folder / "t.npy")
        record = json.loads((self.folder / "m.npy.json").read_text())
        level = record["light"]["exposure"]
        light = ["--exposure", level, "--ppp", ppp, "--force", "--transfer", "as-is"]
        gray = ["--sensor", "qudi-paper", "--bits", 3, "--ppp", ppp, "--exposure", level, "--sum", 1]
        middle, frame_size = truth[MIDDLE], truth.shape[1:3]
        out = {}
        colour, out["seconds"] = self.restored("m.npy", "c.npy")
        out["qudi"] = psnr(colour[MIDDLE], middle)
        out["luma"] = psnr(colour[MIDDLE] @ weights, middle @ weights)
        backbones = ["--backbones", arguments.backbones] if arguments.backbones else []
        for name, frames in (("t1.npy", truth), ("c1.npy", colour)):
            np.save(self.folder / name, frames[MIDDLE : MIDDLE + 1].astype(np.float32))
        document = json.loads(self.run("eval", "t1.npy", "--restored", "c1.npy", "--json", *backbones))
        out["ciede"], out["zipper"] = document["ciede2000_median"], document["zipper"]
        for net in ("alex", "vgg"):
            if document.get(f"lpips_{net}") is not None:
                out[f"lpips {net}"] = document[f"lpips_{net}"]
        if arguments.quick:
            return out
        pictures = {"truth": middle, "qudi": colour[MIDDLE]}
        tile = cfa.split("@")[0]
        if len(tile) == 4 and set(tile) <= set("rgb"):
            self.run("simulate", "--from", "m.npy.json", "-o", "g.npy", "--force")
            all_counts = np.load(self.folder / "g.npy")
            planes = []
            for k in range(4):
                np.save(self.folder / "p.npy", all_counts[:, k // 2 :: 2, k % 2 :: 2])
                planes.append(self.restored("p.npy", "po.npy", *gray)[0][MIDDLE])
                average = self.restored("p.npy", "pa.npy", *gray, "--method", "average")[0][MIDDLE]
                planes[-1] = (planes[-1], average)
            pictures["apart"] = demosaiced([p for p, _ in planes], tile, frame_size)
            pictures["average"] = demosaiced([a for _, a in planes], tile, frame_size)
            frames = [demosaiced([c[k // 2 :: 2, k % 2 :: 2] for k in range(4)], tile, frame_size) for c in all_counts]
            each = []
            for k in range(3):
                rounded = np.stack([frame[..., k] for frame in frames]) + 0.5
                np.save(self.folder / "p.npy", rounded.astype(np.uint8))
                each.append(self.restored("p.npy", "po.npy", *gray)[0][MIDDLE])
            out["each"] = psnr(np.stack(each, -1), middle)
            out["apart"] = psnr(pictures["apart"], middle)
            out["average"] = psnr(pictures["average"], middle)
            counts = all_counts[MIDDLE].astype(float)
            mosaic = np.zeros((*frame_size, 3))
            for k, letter in enumerate(tile):
                mosaic[k // 2 :: 2, k % 2 :: 2, "rgb".index(letter)] = counts[k // 2 :: 2, k % 2 :: 2]
            if arguments.picture:
                panels = [shown(mosaic, 1 / counts.max())]
                for name in ("average", "qudi", "truth"):
                    panels.append(shown(pictures[name], best_gain(pictures[name], middle)))
                gap = np.full((frame_size[0], 6, 3), 255, np.uint8)
                parts = [part for panel in panels for part in (panel, gap)][:-1]
                write_png(arguments.picture, np.concatenate(parts, 1))
        full, planes = [], []
        for seed, (name, clip) in enumerate([("gray", truth @ weights), *[(k, truth[..., k]) for k in range(3)]]):
            np.save(self.folder / "k.npy", clip.astype(np.float32))
            self.run("simulate", "k.npy", "-o", "f.npy", *light, "--seed", 2 + seed)
            restored, seconds = self.restored("f.npy", "fo.npy")
            if name == "gray":
                out["gray luma"], out["gray seconds"] = psnr(restored[MIDDLE], clip[MIDDLE]), seconds
            else:
                full.append(restored[MIDDLE])
                planes.append(np.load(self.folder / "f.npy"))
        out["full"] = psnr(np.stack(full, -1), middle)
        np.save(self.folder / "p.npy", np.stack(planes, -1))
        restored, out["together seconds"] = self.restored("p.npy", "po.npy", *gray)
        out["together"] = psnr(restored[MIDDLE], middle)
        return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("qudi")
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--ppp", default="3.25,9.75")
    parser.add_argument("--pictures", help="names without extension")
    parser.add_argument("--cfa", default="rggb")
    parser.add_argument("--rgbw", action="store_true", help="a random filter of 75.8 %% white pixels")
    parser.add_argument("--backbones", help="folder of the weights of LPIPS")
    parser.add_argument("--size")
    parser.add_argument("--picture", help="write mosaic, average, QuDi and truth of the last picture, .png")
    parser.add_argument("--quick", action="store_true", help="restore with QuDi alone")
    arguments = parser.parse_args()
    pictures = sorted(arguments.folder.resolve().glob("*.png"))
    if arguments.pictures:
        pictures = [p for p in pictures if p.stem in arguments.pictures.split(",")]
    with tempfile.TemporaryDirectory() as scratch:
        runner = Runner(arguments.qudi, pathlib.Path(scratch), arguments)
        for ppp in arguments.ppp.split(","):
            rows = []
            for picture in pictures:
                rows.append(runner.scores(picture, ppp))
                print(ppp, picture.stem, {k: round(v, 4) for k, v in rows[-1].items()}, flush=True)
            means = {k: round(float(np.mean([row[k] for row in rows])), 4) for k in rows[0]}
            print(ppp, "mean of", len(rows), means, flush=True)


if __name__ == "__main__":
    main()
