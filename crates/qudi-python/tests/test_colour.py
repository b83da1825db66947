"""Captures behind a colour filter."""

import numpy as np
import pytest

import qudi_spad as qs

PAPER = {"sensor": "qudi-paper", "ppp": 9.75}
COLOUR = np.array([0.6, 0.3, 0.15])


@pytest.fixture(scope="module")
def scene():
    """A ramp of one colour."""
    light = np.linspace(0.4, 1.0, 40) * np.ones((11, 32, 1))
    return (light[..., None] * COLOUR).astype(np.float32)


@pytest.fixture(scope="module")
def mosaic(scene, tmp_path_factory):
    clip = tmp_path_factory.mktemp("colour") / "clip.npy"
    np.save(clip, scene)
    # One frame of so few pixels: between seeds its chroma differs by up to 7 %.
    counts, record = qs.simulate(clip, cfa="rggb", seed=2, **PAPER)
    assert counts.shape == (11, 32, 40) and record["simulation"]["sensor"]["colour"]["cfa"] == "rggb@0,0"
    return counts


def test_a_mosaic_becomes_colours(mosaic, scene, tmp_path):
    result = qs.restore(mosaic, cfa="rggb", method="qbp-refined", **PAPER)
    assert result.frames.shape == scene.shape and result.sigma is None
    middle = result.frames[5, 4:-4, 4:-4]
    assert np.allclose(middle.mean((0, 1)) / middle[..., 1].mean(), COLOUR / COLOUR[1], rtol=0.05)
    first = next(iter(qs.restore_iter(mosaic, cfa="rggb", method="qbp-refined", **PAPER)))
    assert np.array_equal(first, result.frames[0])
    qs.write(tmp_path / "colours.npy", result.frames)
    assert np.array_equal(np.load(tmp_path / "colours.npy"), result.frames)


def test_colours_have_an_uncertainty_each(mosaic):
    result = qs.restore(mosaic, cfa="rggb", **PAPER)
    assert result.frames.shape == result.sigma.shape == (11, 32, 40, 3)
    assert (result.sigma > 0).all()


def test_luma_alone_and_colours_for_the_eye(mosaic):
    gray = qs.restore(mosaic, cfa="rggb", method="qbp", gray=True, **PAPER)
    assert gray.frames.shape == (11, 32, 40)
    linear = qs.restore(mosaic, cfa="rggb", method="qbp", **PAPER).frames
    shown = qs.restore(mosaic, cfa="rggb", method="qbp", tonemap="srgb", wb="1,1,1", **PAPER).frames
    assert np.allclose(shown, np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055), atol=1e-4)


def test_filters_that_there_are_not(mosaic):
    for cfa in ["rgxb", "rrrr", "rggb@7"]:
        with pytest.raises(ValueError, match="cfa|filter"):
            qs.restore(mosaic, cfa=cfa, method="qbp", **PAPER)
    with pytest.raises(ValueError, match="gray"):
        qs.restore(mosaic[:, ::2, ::2], gray=True, method="qbp", **PAPER)
