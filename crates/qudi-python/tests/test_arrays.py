"""Arrays of any kind: no exception but ours, and no crash."""

import warnings

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import qudi_spad as qs

OURS = (ValueError, TypeError, IndexError)


def restore(array, **options):
    return qs.restore(array, **{"sensor": "qudi-paper", "ppp": 5.0, "method": "mle", **options})


@pytest.fixture
def frames():
    light = np.linspace(1, 4, 24) * np.ones((5, 16, 1))
    return np.random.default_rng(1).poisson(light).clip(0, 7).astype(np.uint8)


@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "<u4", ">i8", "i1", "<i2", "<f4", ">f8"])
def test_every_type_holds_the_same_counts(frames, dtype):
    expected = restore(frames)
    assert np.array_equal(restore(frames.astype(dtype)).frames, expected.frames)


def test_layouts_hold_the_same_counts(frames):
    expected = restore(frames).frames
    read_only = frames.copy()
    read_only.flags.writeable = False
    wide = np.zeros((10, 16, 48), np.uint8)
    wide[::2, :, ::2] = frames
    layouts = [np.asfortranarray(frames), wide[::2, :, ::2], read_only, frames[::-1][::-1], frames.tolist()]
    for array in layouts[:-1]:
        assert np.array_equal(restore(array).frames, expected)
    assert np.array_equal(restore(np.asarray(layouts[-1])).frames, expected)
    assert np.array_equal(restore(np.moveaxis(frames, 0, -1), axes="hwt").frames, expected)


@pytest.mark.parametrize(
    ("array", "error", "text"),
    [
        (np.zeros((), np.uint8), qs.FormatError, "single number"),
        (np.zeros(9, np.uint8), qs.FormatError, "shape"),
        (np.zeros((2, 3, 4, 5, 6), np.uint8), qs.FormatError, "shape"),
        (np.zeros((0, 16, 16), np.uint8), qs.FormatError, "no frames"),
        (np.full((5, 16, 16), -1), qs.FormatError, "-1"),
        (np.full((5, 16, 16), 0.5), qs.FormatError, "0.5"),
        (np.full((5, 16, 16), np.nan), qs.FormatError, "NaN"),
        (np.full((5, 16, 16), 70000), qs.FormatError, "70000"),
        (np.full((5, 16, 16), 1j), qs.FormatError, "c16"),
        (np.full((5, 16, 16), None), qs.FormatError, "O"),
    ],
)
def test_bad_arrays_are_named(array, error, text):
    with pytest.raises(error, match=text) as raised:
        restore(array)
    assert "where:" in str(raised.value) and "help:" in str(raised.value)


def test_counts_beyond_the_sensor(frames):
    with pytest.raises((qs.FormatError, qs.SensorMismatch)) as raised:
        restore(frames + 100, bits=3)
    assert "help:" in str(raised.value)
    with pytest.raises(qs.SensorMismatch, match="linear sensor"):
        restore(frames > 3)


def test_windows_that_are_too_short(frames):
    with pytest.raises(ValueError, match="frames") as raised:
        restore(frames[:2], method="qudi")
    assert "help:" in str(raised.value)


def test_unknown_options_are_no_keywords(frames):
    with pytest.raises(TypeError, match="nonsense"):
        restore(frames, nonsense=3)
    with pytest.raises(ValueError, match="method"):
        restore(frames, method="nonsense")


SHAPES = st.one_of(
    arrays.array_shapes(min_dims=0, max_dims=5, min_side=0, max_side=4),
    st.tuples(st.sampled_from([1, 2, 3, 5]), st.sampled_from([1, 7, 16]), st.sampled_from([1, 9, 16])),
)
TYPES = st.one_of(
    arrays.boolean_dtypes(),
    arrays.integer_dtypes(),
    arrays.unsigned_integer_dtypes(),
    arrays.floating_dtypes(),
    arrays.complex_number_dtypes(),
    arrays.datetime64_dtypes(),
    arrays.byte_string_dtypes(),
)


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    array=TYPES.flatmap(lambda dtype: arrays.arrays(dtype, SHAPES, fill=st.nothing())),
    order=st.sampled_from(["C", "F", "reversed", "strided", "read-only"]),
    sensor=st.sampled_from(["qudi-paper", "swissspad2", None]),
)
def test_no_array_crashes_the_interpreter(array, order, sensor):
    if order == "F":
        array = np.asfortranarray(array)
    elif order == "reversed" and array.ndim:
        array = array[..., ::-1]
    elif order == "strided" and array.ndim:
        array = np.repeat(array, 2, axis=-1)[..., ::2]
    elif order == "read-only":
        array.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            result = qs.restore(array, sensor=sensor, ppp=3.0, method="average", mask="none")
        except OURS as error:
            assert str(error)
        else:
            assert result.frames.dtype == np.float32 and result.frames.ndim == 3
            assert np.isfinite(result.frames).all()
