"""Captures that the tests share, made by the package itself."""

import numpy as np
import pytest

import qudi_spad as qs


@pytest.fixture(scope="session")
def burst():
    """Counts of 11 frames by the paper's sensor, and their record."""
    return qs.simulate("scene:dead-leaves", ppp=9.75, seed=3, frames=11, size=(64, 64))


@pytest.fixture(scope="session")
def counts(burst):
    return burst[0]


@pytest.fixture(scope="session")
def restored(counts):
    return qs.restore(counts, sensor="qudi-paper", ppp=9.75, method="qbp")


@pytest.fixture(scope="session")
def bits():
    """77 binary frames of a SwissSPAD2, unpacked."""
    counts, _ = qs.simulate(
        "scene:dead-leaves", sensor="swissspad2", ppp=1.0, seed=4, frames=77, size=(64, 64), speed=0.05
    )
    return counts.astype(bool)


@pytest.fixture
def npy(tmp_path, counts):
    path = tmp_path / "burst.npy"
    np.save(path, counts)
    return path
