"""Properties that hold for any input: rotations, resampling, the median, gait windows, and readers of damaged files."""

import functools
import io
import pickle
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fmpjax import metrics, robots, rotations, transport
from fmpjax.errors import UserError
from fmpjax.motion import clip as clips
from fmpjax.motion import readers
from fmpjax.motion.readers import archive
from fmpjax.motion.readers.recording import Options

# The same examples in every run; a slow machine is no failure.
settings.register_profile("fmpjax", derandomize=True, max_examples=50, deadline=None, database=None)
settings.load_profile("fmpjax")


def vectors(size, most):
    return arrays.arrays(np.float64, (4, size), elements=st.floats(-most, most))


@st.composite
def quaternions(draw):
    """Unit quaternions ``[4, 4]`` of any sign, from rotation vectors."""
    sign = draw(arrays.arrays(np.float64, (4, 1), elements=st.sampled_from([-1.0, 1.0])))
    return sign * rotations.exp_map(draw(vectors(3, 10.0)))


def close(a, b, tolerance=1e-9):
    np.testing.assert_allclose(a, b, atol=tolerance)


def matrix(q_wxyz):
    """Rotation matrices ``[..., 3, 3]``, column by column."""
    return np.stack([rotations.rotate(q_wxyz, np.broadcast_to(axis, (4, 3))) for axis in np.eye(3)], axis=-1)


# --- rotations -------------------------------------------------------------------------------------------------------


@given(quaternions(), quaternions(), vectors(3, 100.0))
def test_a_product_rotates_as_its_factors_do_in_turn(a_wxyz, b_wxyz, v):
    product = rotations.multiply(a_wxyz, b_wxyz)
    close(np.linalg.norm(product, axis=-1), 1.0)
    close(rotations.rotate(product, v), rotations.rotate(a_wxyz, rotations.rotate(b_wxyz, v)), 1e-10 * 100)
    close(rotations.rotate(rotations.conjugate(a_wxyz), rotations.rotate(a_wxyz, v)), v, 1e-10 * 100)


@given(quaternions())
def test_the_logarithm_is_the_shorter_rotation_and_the_exponential_undoes_it(q_wxyz):
    turn = rotations.log_map(q_wxyz)
    assert (np.linalg.norm(turn, axis=-1) <= np.pi + 1e-9).all()
    close(matrix(rotations.exp_map(turn)), matrix(q_wxyz))


@given(quaternions())
def test_the_figures_of_a_rotation_are_those_of_its_matrix(q_wxyz):
    axes = matrix(q_wxyz)
    close(rotations.to_6d(q_wxyz), np.concatenate([axes[..., 0], axes[..., 2]], axis=-1))
    close(rotations.up(q_wxyz), axes[:, 2, 2])
    level = np.linalg.norm(axes[:, :2, 0], axis=-1)
    close(level * np.exp(1j * rotations.yaw(q_wxyz)), axes[:, 0, 0] + 1j * axes[:, 1, 0])


@given(quaternions(), quaternions(), st.floats(0.0, 1.0))
def test_interpolation_goes_the_shorter_way_at_an_even_rate(a_wxyz, b_wxyz, fraction):
    middle = rotations.slerp(a_wxyz, b_wxyz, np.full((4, 1), fraction))
    whole = rotations.log_map(rotations.multiply(rotations.conjugate(a_wxyz), b_wxyz))
    part = rotations.log_map(rotations.multiply(rotations.conjugate(a_wxyz), middle))
    # A half turn has two shorter ways.
    clear = np.linalg.norm(whole, axis=-1) < np.pi - 1e-3
    close(part[clear], fraction * whole[clear], 1e-7)


# --- resampling ------------------------------------------------------------------------------------------------------


@st.composite
def motions(draw):
    """Configurations ``[T, 9]`` of a robot with two joints, quaternions of any length and sign."""
    rows = draw(st.integers(2, 12))
    q_wxyz = draw(arrays.arrays(np.float64, (rows, 4), elements=st.floats(0.1, 1.0)))
    sign = draw(arrays.arrays(np.float64, (rows, 1), elements=st.sampled_from([-1.0, 1.0])))
    rest = draw(arrays.arrays(np.float64, (rows, 5), elements=st.floats(-10.0, 10.0)))
    return np.concatenate([rest[:, :3], sign * q_wxyz, rest[:, 3:]], axis=1)


RATES = st.sampled_from([10.0, 29.97, 30.0, 50.0, 60.0, 120.0])


@given(motions(), RATES, RATES)
def test_a_resampled_motion_stays_within_the_source_and_on_its_times(qpos, source_rate, rate):
    out = clips.resample(qpos, source_rate, rate)
    assert len(out) == clips.sample_count(len(qpos), source_rate, rate)
    assert (len(out) - 1) / rate <= (len(qpos) - 1) / source_rate + 1e-6
    rest = [0, 1, 2, 7, 8]
    assert (out[:, rest] <= qpos[:, rest].max(axis=0) + 1e-9).all()
    assert (out[:, rest] >= qpos[:, rest].min(axis=0) - 1e-9).all()
    close(np.linalg.norm(out[:, 3:7], axis=1), 1.0)
    assert (np.sum(out[1:, 3:7] * out[:-1, 3:7], axis=1) >= -1e-9).all()
    close(out[0, rest], qpos[0, rest])


@given(motions(), st.integers(1, 5))
def test_refining_or_a_multiple_of_the_rate_keeps_every_sample(qpos, parts):
    clip = clips.MotionClip.from_qpos("a", "b", 20.0, qpos)
    close(clips.resample(clip.qpos, 20.0, 20.0 * parts)[::parts], clip.qpos, 1e-6)
    fine = clips.refined(clip, parts)
    assert fine.rate == 20.0 * parts and len(fine) == (len(clip) - 1) * parts + 1
    close(fine.qpos[::parts], clip.qpos)


# --- median and windows ----------------------------------------------------------------------------------------------


@functools.cache
def median_of(size):
    """The compiled median of an array of one size."""
    return jax.jit(transport.median)


MAGNITUDES = st.floats(0, 2.0**100, width=32, allow_subnormal=False)


@given(st.sampled_from([1, 2, 7, 12]).flatmap(lambda size: arrays.arrays(np.float32, size, elements=MAGNITUDES)))
def test_the_median_is_numpys(values):
    expected = np.median(values.astype(np.float64))
    np.testing.assert_allclose(median_of(len(values))(jnp.asarray(values)), expected, rtol=1e-6)


@given(
    arrays.arrays(np.float64, (23, 3, 6), elements=st.floats(-3, 3)),
    arrays.arrays(np.int64, 3, elements=st.integers(1, 23)),
    st.floats(-5, 5),
)
def test_windows_know_no_row_after_the_episode_and_no_offset(joints, length, offset):
    order = np.arange(6)
    ranges = metrics.window_ranges(joints, length, order, rate=10.0, window=1.0)
    after = np.arange(23)[:, None] >= length
    other = np.where(after[..., None], 1e6, joints)
    np.testing.assert_array_equal(metrics.window_ranges(other, length, order, rate=10.0, window=1.0), ranges)
    shifted = metrics.window_ranges(joints + offset, length, order, rate=10.0, window=1.0)
    np.testing.assert_allclose(shifted, ranges, atol=1e-9)
    assert ranges.shape == (2, 3, 6) and (np.isfinite(ranges[:, :, 0]).sum(axis=0) == length // 10).all()
    widest = np.ptp(joints[:20].reshape(2, 10, 3, 6), axis=1)
    assert (np.nan_to_num(ranges) <= widest + 1e-9).all() and (np.nan_to_num(ranges) >= 0).all()
    mirrored = metrics.left_right_imbalance(ranges[..., [3, 4, 5, 0, 1, 2]])
    np.testing.assert_allclose(mirrored, metrics.left_right_imbalance(ranges), atol=1e-12)


# --- readers ---------------------------------------------------------------------------------------------------------

ROBOT = robots.load("strider")


def _frames():
    """Three configurations ``[3, 7 + J]`` that differ."""
    qpos = np.repeat(ROBOT.default_qpos[None], 3, axis=0)
    return qpos + 0.01 * np.arange(3)[:, None]


def _archive(save):
    out = io.BytesIO()
    save(out, qpos=_frames(), rate=np.float64(50), robot=np.str_("strider"), names=np.array(["a", "b"], object))
    return out.getvalue()


def _pickle(protocol):
    qpos = _frames()
    turn = rotations.log_map(qpos[:, 3:7] / np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True))
    frames = np.concatenate([qpos[:, :3], turn, qpos[:, 7:]], axis=1)
    return pickle.dumps({"fps": 50, "loop_mode": 0, "frames": frames}, protocol)


FILES = {
    "archive": _archive(np.savez),
    "compressed": _archive(np.savez_compressed),
    "pickle": _pickle(4),
    "old pickle": _pickle(0),
    "text": "\n".join(",".join(map(str, row[[0, 1, 2, 4, 5, 6, 3, *range(7, 19)]])) for row in _frames()).encode(),
}


def read(path, raw):
    """Reads bytes as a motion file: right, or one sentence that names the file."""
    path.write_bytes(raw)
    try:
        recording = readers.read(path, ROBOT, Options(fps=50.0))
    except UserError as error:
        said = str(error)
        assert str(path) in said and "\n" not in said and len(said) < 600, said
        return None
    assert recording.qpos.ndim == 2 and recording.qpos.shape[1] == 19 and np.isfinite(recording.qpos).all()
    return recording


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged") / "clip"


@pytest.mark.parametrize("kind", FILES)
def test_an_undamaged_file_is_read(path, kind):
    assert len(read(path, FILES[kind]).qpos) == 3


@pytest.mark.parametrize("kind", FILES)
@given(data=st.data())
def test_flipped_bytes_are_read_or_refused_in_a_sentence(path, kind, data):
    raw = bytearray(FILES[kind])
    for at, byte in data.draw(st.lists(st.tuples(st.integers(0, len(raw) - 1), st.integers(0, 255)), max_size=4)):
        raw[at] = byte
    read(path, bytes(raw[: data.draw(st.integers(0, len(raw)) | st.just(len(raw)))]))


@given(st.sampled_from([b"PK\x03\x04", b"\x80\x04", b"}", b"(", b"\x1f\x8b", b"x\x9c", b"BZ", b"]\x00", b""]),
       st.binary(max_size=200))  # fmt: skip
def test_random_bytes_are_refused_in_a_sentence(path, head, raw):
    assert read(path, head + raw) is None


def _member(header, compression=zipfile.ZIP_STORED):
    """An archive with one array of that header."""
    out, text = io.BytesIO(), header.encode() + b"\n"
    with zipfile.ZipFile(out, "w", compression) as archive:
        archive.writestr("rate.npy", b"")
        archive.writestr("qpos.npy", b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text + bytes(24))
    return out.getvalue()


@pytest.mark.parametrize("header", ["{'shape': (3,", "'''", "-" * 9000 + "1", "(" * 5000])
def test_headers_that_python_cannot_parse_are_refused(path, header):
    path.write_bytes(_member(header))
    with pytest.raises(UserError, match="not a readable .npz archive"):
        archive.Arrays(path)["qpos"]


def test_a_member_that_claims_another_compression_is_refused(path):
    """The byte that LZMA takes for its options is tried at every value."""
    raw = bytearray(_member("{'descr': '<f8', 'fortran_order': False, 'shape': (3,), }", zipfile.ZIP_DEFLATED))
    local, central = raw.rindex(b"PK\x03\x04"), raw.rindex(b"PK\x01\x02")
    raw[local + 8] = raw[central + 10] = zipfile.ZIP_LZMA
    start = local + 30 + len("qpos.npy")
    raw[start + 2 : start + 4] = b"\x05\0"  # size of the options
    for byte in range(256):
        raw[start + 4] = byte
        path.write_bytes(raw)
        with pytest.raises(UserError, match="not a readable .npz archive"):
            archive.Arrays(path)["qpos"]
