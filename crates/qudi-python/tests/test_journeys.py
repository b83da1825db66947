"""Twelve journeys, each as a newcomer would go."""

import os
import signal
import threading
import time

import numpy as np
import pytest

import qudi_spad as qs

PAPER = {"sensor": "qudi-paper", "ppp": 9.75, "method": "qbp"}


def test_video(tmp_path):
    """A clip in NumPy becomes counts, the counts a video."""
    rows, columns = np.mgrid[:64, :64]
    clip = np.stack([np.sin((rows + columns + t) / 6) ** 2 for t in range(11)]).astype(np.float32)
    counts, record = qs.simulate(clip, sensor="qudi-paper", ppp=20, seed=1)
    assert counts.shape == (11, 64, 64) and record["simulation"]["seed"] == 1
    result = qs.restore(counts, sensor="qudi-paper", ppp=20, method="qbp-bm3d")
    assert qs.metrics.psnr_aligned(result.frames, clip).mean() > 20
    qs.write(tmp_path / "video.gif", result.frames, fps=10)
    assert (tmp_path / "video.gif").stat().st_size > 1000


def test_spad512_raw(tmp_path):
    """Raw one-bit frames of an SPAD512S, 512 x 512, highest bit first."""
    rng = np.random.default_rng(0)
    light = 0.1 + 0.3 * np.linspace(0, 1, 512)[None, :] * np.ones((512, 1))
    frames = rng.random((24, 512, 512)) < light
    np.packbits(frames, axis=-1).tofile(tmp_path / "RAW00000.bin")
    capture = qs.open(tmp_path / "RAW00000.bin", format="spad512s", orient="raw")
    assert capture.shape == (24, 512, 512) and capture.dtype == np.uint8
    assert capture.sensor.name == "spad512s"
    assert np.array_equal(capture[5], frames[5])
    result = qs.restore(capture, sum=6, method="mle")
    assert result.frames.shape == (4, 512, 512)


def test_tiff_stack(tmp_path, counts, restored):
    qs.write(tmp_path / "counts.tif", counts, bits=3)
    tifffile = pytest.importorskip("tifffile")
    assert np.array_equal(tifffile.imread(tmp_path / "counts.tif"), counts)
    assert np.array_equal(qs.read(tmp_path / "counts.tif"), counts)
    result = qs.restore(tmp_path / "counts.tif", **PAPER)
    assert np.array_equal(result.frames, restored.frames)
    qs.write(tmp_path / "restored.tif", result.frames)
    assert np.array_equal(tifffile.imread(tmp_path / "restored.tif"), result.frames)


def test_hdf5(tmp_path, counts, restored):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "capture.h5", "w") as file:
        file.create_dataset("counts", data=counts, chunks=(1, 64, 64), compression="gzip")
    assert np.array_equal(qs.read(tmp_path / "capture.h5"), counts)
    with h5py.File(tmp_path / "capture.h5") as file:
        result = qs.restore(file["counts"], **PAPER)
    assert np.array_equal(result.frames, restored.frames)


def test_mat(tmp_path, counts, restored):
    io = pytest.importorskip("scipy.io")
    io.savemat(tmp_path / "capture.mat", {"OUTPUT": np.moveaxis(counts, 0, -1)})
    capture = qs.open(tmp_path / "capture.mat")
    assert np.array_equal(np.asarray(capture), counts)
    assert np.array_equal(qs.restore(capture, **PAPER).frames, restored.frames)


class Tensor:
    """A tensor of PyTorch or JAX on the CPU, as far as NumPy sees it."""

    def __init__(self, values):
        self._values = values
        self.shape, self.dtype = values.shape, "torch.uint8"

    def __getitem__(self, key):
        return Tensor(self._values[key])

    def __dlpack__(self, **options):
        return self._values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self._values.__dlpack_device__()


def test_torch_tensor(counts, restored):
    try:
        import torch
    except ImportError:
        tensor = Tensor(np.array(counts))
    else:
        tensor = torch.from_numpy(np.array(counts))
    assert np.array_equal(qs.restore(tensor, **PAPER).frames, restored.frames)


def test_memory_map(npy, counts, restored):
    mapped = np.load(npy, mmap_mode="r")
    reads = []

    class Watched:
        shape, dtype = mapped.shape, mapped.dtype

        def __getitem__(self, key):
            reads.append(key)
            return mapped[key]

    capture = qs.open(Watched())
    assert np.array_equal(capture[4:6], counts[4:6])
    assert all(key.stop - key.start <= 11 for key in reads)
    assert np.array_equal(qs.restore(mapped, **PAPER).frames, restored.frames)


@pytest.mark.skipif(os.name == "nt", reason="signals of other systems")
def test_notebook_interrupt(counts):
    """Interrupting the cell stops the restoration between tiles, and the next cell works."""
    # Python ignores the signal where the shell that started it in the background does.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    long = np.concatenate([counts] * 40)
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    start = time.monotonic()
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        qs.restore(long, sensor="qudi-paper", ppp=9.75, method="qbp-refined")
    assert time.monotonic() - start < 15
    assert len(qs.restore(counts, **PAPER).frames) == 11


def test_two_threads(counts, restored):
    results = [None, None]

    def work(n):
        results[n] = qs.restore(counts, **PAPER).frames

    threads = [threading.Thread(target=work, args=(n,)) for n in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(frames, restored.frames) for frames in results)


def test_bad_file(tmp_path):
    (tmp_path / "notes.txt").write_text("no capture")
    with pytest.raises(qs.FormatError, match="no known format") as error:
        qs.open(tmp_path / "notes.txt")
    assert "where:" in str(error.value) and "help:" in str(error.value)
    with pytest.raises(FileNotFoundError):
        qs.open(tmp_path / "missing.npy")
    np.save(tmp_path / "cut.npy", np.arange(3000, dtype=np.uint8).reshape(3, 10, 100) % 7)
    whole = (tmp_path / "cut.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(whole[:-10])
    with pytest.raises(qs.FormatError, match="truncated"):
        qs.read(tmp_path / "cut.npy")


def test_packed_bits_without_a_record(bits):
    """A uint8 array of packed bits, as numpy.packbits makes it, says nothing of itself."""
    packed = np.packbits(bits, axis=-1)
    capture = qs.open(packed)
    assert capture.shape == bits.shape and np.array_equal(capture[:], bits)
    result = qs.restore(packed, sensor="swissspad2", sum=7, method="mle")
    assert result.frames.shape == (11, 64, 64)
    assert result.manifest["settings"]["read"]["sum"] == 7


def test_live_stream(counts, restored):
    """Frames come from a camera one by one; restored ones follow before the camera stops."""
    seen = []

    def camera():
        for n, frame in enumerate(np.concatenate([counts] * 3)):
            seen.append(n)
            yield frame

    stream = qs.restore_iter(camera(), sensor="qudi-paper", ppp=9.75, method="qbp", bits=3)
    first = next(stream)
    assert first.shape == (64, 64) and first.dtype == np.float32
    assert seen[-1] < 32
    rest = list(stream)
    assert len(rest) == 32
    whole = qs.restore(np.concatenate([counts] * 3), sensor="qudi-paper", ppp=9.75, method="qbp", bits=3)
    assert np.array_equal(np.stack([first, *rest]), whole.frames)
