#!/usr/bin/env python3
"""Small captures written by other programs, for crates/qudi-io/tests/captures/foreign.rs.

    pip install numpy scipy pillow tifffile h5py
    python tests/golden/generate/captures.py tests/golden/captures

Every file holds the same 6 frames of 12 x 20 pixels: `counts.npy` (3 bit) or `bits.npy` (1 bit).
"""
import gzip
import json
import sys
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import tifffile
from PIL import Image

out = Path(sys.argv[1])
for folder in ("tiff", "mat", "hdf5"):
    (out / folder).mkdir(parents=True, exist_ok=True)
rng = np.random.default_rng(20)
light = np.linspace(0.1, 0.8, 20) * np.linspace(0.4, 1, 12)[:, None]
counts = rng.binomial(7, light, (6, 12, 20)).astype(np.uint8)
bits = (rng.random((6, 12, 20)) < light).astype(np.uint8)
np.save(out / "counts.npy", counts)
np.save(out / "bits.npy", bits)

# NumPy archives, with a label next to the counts, as spike cameras' data come.
np.savez(out / "stored.npz", spk=counts, label=np.int64(3), name=np.array("a.jpg"))
np.savez_compressed(out / "deflated.npz", spk=counts, label=np.int64(3), name=np.array("a.jpg"))
np.savez(out / "two.npz", left=counts, right=bits)
with gzip.GzipFile(out / "counts.npy.gz", "wb", mtime=0) as f:
    np.save(f, counts)
np.save(out / "fortran.npy", np.asfortranarray(counts))
np.save(out / "wide.npy", counts.astype(np.int64))

# MATLAB: height x width x frames.
stack = np.ascontiguousarray(counts.transpose(1, 2, 0))
scipy.io.savemat(out / "mat/plain.mat", {"OUTPUT": stack, "note": "text"}, do_compression=False)
scipy.io.savemat(out / "mat/compressed.mat", {"OUTPUT": stack, "x": 1.0}, do_compression=True)
scipy.io.savemat(out / "mat/dcr.mat", {"dcr": np.where(light > 0.75, 500.0, 7.5)}, do_compression=True)
scipy.io.savemat(out / "mat/bayer.mat", {"imbs": stack, "dataParam": 1.0}, do_compression=True)
parts = out / "parts"
parts.mkdir(exist_ok=True)
for k, part in enumerate(np.split(bits.transpose(1, 2, 0).astype(bool), [2, 4], axis=2), 1):
    scipy.io.savemat(parts / f"part_{k}.mat", {"OUTPUT": part}, do_compression=k != 2)
(parts / "info.json").write_text(json.dumps({"no_parts": 3, "no_frames": 2}))

# TIFF: pages, ImageJ's block, compressed pages, means scaled to full range.
tifffile.imwrite(out / "tiff/pages.tif", counts, photometric="minisblack")
tifffile.imwrite(out / "tiff/imagej.tif", counts.astype(np.uint16), imagej=True)
tifffile.imwrite(out / "tiff/deflate.tif", counts.astype(np.uint16), compression="zlib", photometric="minisblack")
tifffile.imwrite(out / "tiff/float.tif", counts.astype(np.float32), photometric="minisblack")
tifffile.imwrite(out / "tiff/means.tif", np.round(counts * (255 / 7)).astype(np.uint8), photometric="minisblack")
tifffile.imwrite(out / "tiff/bilevel.tif", bits.astype(bool), photometric="minisblack")
tifffile.imwrite(out / "tiff/rgb.tif", np.repeat(counts[..., None], 3, axis=-1), photometric="rgb")

# Images: 0/255, out of alphabetical order.
images = out / "images"
images.mkdir(exist_ok=True)
for t, frame in enumerate(bits):
    Image.fromarray(frame * np.uint8(255)).save(images / f"IMG{t + 8}.png")

# visionsim: packed along the width, and along the height.
for dim in (1, 2):
    folder = out / f"visionsim{dim}"
    folder.mkdir(exist_ok=True)
    np.save(folder / "frames.npy", np.packbits(bits, axis=dim))
    transforms = {"file_path": "frames.npy", "w": 20, "h": 12, "c": 1, "bitpack": True, "bitpack_dim": dim}
    transforms["frames"] = [{"transform_matrix": np.eye(4).tolist()} for _ in bits]
    (folder / "transforms.json").write_text(json.dumps(transforms))
folder = out / "visionsim_colour"
folder.mkdir(exist_ok=True)
np.save(folder / "frames.npy", np.packbits(np.repeat(bits[:2, ..., None], 3, axis=-1), axis=2))
transforms |= {"c": 3, "frames": []}
(folder / "transforms.json").write_text(json.dumps(transforms))

# HDF5: plain, chunked, MATLAB 7.3 (frames x width x height), frames as numbered datasets.
with h5py.File(out / "hdf5/chunked.h5", "w") as f:
    f.create_dataset("run/counts", data=counts, chunks=(4, 5, 7), compression="gzip", shuffle=True)
    f.create_dataset("label", data=3)
with h5py.File(out / "hdf5/contiguous.h5", "w") as f:
    f.create_dataset("counts", data=counts.astype(">u2"))
with h5py.File(out / "hdf5/packed.h5", "w") as f:
    f.create_dataset("frames", data=np.packbits(np.tile(bits, (40, 1, 1)), axis=2), chunks=(16, 12, 3), compression="gzip")
with h5py.File(out / "hdf5/soft.h5", "w") as f:
    f["frames"] = counts
    f["again"] = h5py.SoftLink("/frames")
with h5py.File(out / "hdf5/master.h5", "w") as f:
    f["data_000001"] = h5py.ExternalLink("chunked.h5", "/run/counts")
    f["data_000002"] = h5py.ExternalLink("contiguous.h5", "/counts")
with h5py.File(out / "hdf5/mixed.h5", "w") as f:
    f["data_000001"] = counts[:2]
    f["data_000002"] = h5py.ExternalLink("contiguous.h5", "/counts")
with h5py.File(out / "mat/matlab73.mat", "w", userblock_size=512) as f:
    d = f.create_dataset("OUTPUT", data=np.ascontiguousarray(counts.transpose(0, 2, 1)), chunks=(2, 20, 12), compression="gzip")
    d.attrs["MATLAB_class"] = np.bytes_(b"uint8")
with open(out / "mat/matlab73.mat", "r+b") as f:
    f.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
for name, pattern in (("mono", None), ("cfa", "RGGB")):
    with h5py.File(out / f"hdf5/{name}.ubi.h5", "w") as f:
        group = f.create_group("capture_integrated/raw_hdf5")
        schedule = {"schedule": {"base_schedule": {"binary_frame_rate_fps": 70000.0}}}
        group.attrs["metadata"] = json.dumps({
            "cfa_pattern": pattern,
            "polycam_metadata": {"num_integrated_binary_frames": 7},
            "node_history": [schedule],
        })
        for t, frame in enumerate(counts):
            group.create_dataset(f"{9998 + t:06d}", data=frame[..., None, None])
