"""SMPL, SMPL-H and SMPL-X motions as AMASS writes them: rotations of a body model's joints.

An ``.npz`` has ``trans [T, 3]`` (m), the joints' rotation vectors as ``poses [T, 3 K]`` or as ``root_orient`` and
``pose_body``, ``betas`` (the body's shape), ``gender`` and ``mocap_framerate`` or ``mocap_frame_rate``. z is up.

Where the joints are in the body is not in the file but in the body model, which its makers license and the user
brings. Only the 22 joints of the body are used, which are the same in all three models; hands and face are not.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion.readers.archive import Arrays
from fmpjax.motion.readers.recording import positive, table, texts
from fmpjax.motion.skeleton import JointPoses, posed

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19])
# What programs call the same array; the first that a file has is read.
PLACE, ROOT, BODY = ("trans", "transl"), ("root_orient", "global_orient"), ("pose_body", "body_pose")
RATE = ("mocap_framerate", "mocap_frame_rate", "fps")
# How many columns of a model's shapes are of the body where others are of the face, by their number in SMPL-X.
SHAPES = {400: 300, 20: 10}
MODEL = ("v_template", "shapedirs", "J_regressor", "kintree_table")
MOST_VERTICES = 100_000
BRING = (
    "--body-model FILE, the model's .npz from its makers: smplh/GENDER/model.npz (SMPL+H, mano.is.tue.mpg.de) or "
    "SMPLX_GENDER.npz (SMPL-X, smpl-x.is.tue.mpg.de)"
)


class Smpl(NamedTuple):
    """A body of `JOINTS` that moves for ``T`` frames."""

    offset: np.ndarray  # [22, 3] m, of each joint in its parent; of the pelvis from ``trans``
    rate: float  # Hz
    values: np.ndarray  # [T, 3 + 66] place of the body m, rotation vectors of the joints rad
    format: str
    names: tuple[str, ...] = JOINTS
    parent: np.ndarray = PARENTS

    def taken(self, values: np.ndarray) -> "Smpl":
        """The same body with other frames ``[T, 69]``."""
        return self._replace(values=values)

    def poses(self, joints: Sequence[int] | None = None) -> JointPoses:
        """Where the ``joints``, by default all, are in every frame."""

        def local(joint: int) -> tuple[np.ndarray, np.ndarray]:
            moved = np.tile(self.offset[joint], (len(self.values), 1))
            moved = moved + self.values[:, :3] if joint == 0 else moved
            return moved, rotations.exp_map(self.values[:, 3 + 3 * joint : 6 + 3 * joint])

        return posed(self.parent, local, joints)


def holds(content: Mapping) -> bool:
    """Whether a file's arrays are parameters of a body model."""
    parts = _key(content, ROOT) and _key(content, BODY)
    return bool(_key(content, PLACE) and ("poses" in content or parts))


def read(file: Path, content: Mapping, model: Path | None) -> Smpl:
    """Read a motion of a body model from a file's arrays, with the body ``model`` that it is for.

    Raises:
      UserError: a file cannot be read, is another one, or there is no model.
    """
    if not holds(content):
        names = ", ".join(sorted(content)[:8]) or "nothing"
        raise UserError(f"{file}: the file holds {names[:200]}, expected BVH or SMPL's trans and poses")
    gender = _text(file, content, "gender")
    if model is None:
        raise UserError(
            f"{file}: SMPL parameters{f' ({gender})' if gender else ''} do not contain the positions of the joints, "
            f"expected {BRING}"
        )
    place = _key(content, PLACE)
    position = table(file, place, content[place], 3)
    turned = _rotations(file, content)
    if len(position) != len(turned) or not len(turned):
        raise UserError(
            f"{file}: {len(position)} positions of the body and {len(turned)} poses, expected the same number of both"
        )
    rate = _key(content, RATE)
    if not rate:
        raise UserError(f"{file}: no {' or '.join(RATE[:2])}, expected the rate in Hz")
    betas = table(file, "betas", _flat(content["betas"], 0)) if "betas" in content else np.zeros(0)
    places = joint_places(model, betas)
    offset = np.concatenate([places[:1], places[1:] - places[PARENTS[1:]]])
    about = f"SMPL, {len(betas)} betas{f', {gender}' if gender else ''}"
    return Smpl(offset, positive(file, rate, content[rate]), np.concatenate([position, turned], axis=1), about)


def joint_places(model: Path, betas: np.ndarray) -> np.ndarray:
    """Places ``[22, 3]`` (m) of the body's joints at rest, from a body model's file and the shape ``betas [B]``.

    Raises:
      UserError: the file cannot be read or is no body model.
    """
    with _opened(model) as stream:
        head = stream.read(2)
    if head != b"PK":
        raise UserError(f"{model}: not an .npz, expected {BRING}")
    content = Arrays(model)
    missing = [name for name in MODEL if name not in content]
    if missing:
        raise UserError(f"{model}: no {missing[0]}, expected {BRING}")
    vertices = table(model, "v_template", content["v_template"], 3)
    if not 0 < len(vertices) <= MOST_VERTICES:
        raise UserError(f"{model}: {len(vertices)} vertices, expected 1 to {MOST_VERTICES}")
    shapes = content["shapedirs"]
    if shapes.dtype.kind != "f" or shapes.ndim != 3 or shapes.shape[:2] != vertices.shape:
        raise UserError(
            f"{model}: shapedirs is {shapes.dtype} of shape {shapes.shape}, expected ({len(vertices)}, 3, any)"
        )
    used = min(len(betas), SHAPES.get(shapes.shape[2], shapes.shape[2]))
    regressor = table(model, "J_regressor", content["J_regressor"], len(vertices))
    parents = content["kintree_table"]
    if parents.dtype.kind not in "iu" or parents.ndim != 2 or parents.shape[1] != len(regressor):
        raise UserError(
            f"{model}: kintree_table of shape {parents.shape}, expected one parent for each of {len(regressor)} joints"
        )
    count = len(JOINTS)
    if not np.array_equal(parents[0, 1:count].astype(np.int64), PARENTS[1:]):
        raise UserError(f"{model}: the first {count} joints are not connected like those of SMPL, SMPL-H and SMPL-X")
    places = regressor[:count] @ (vertices + shapes[:, :, :used].astype(np.float64) @ betas[:used])
    if not np.isfinite(places).all() or np.linalg.norm(np.ptp(places, axis=0)) > 10:
        raise UserError(f"{model}: joints are too far apart for a body, expected a body in meters")
    return places


def _rotations(file: Path, content: Mapping) -> np.ndarray:
    """Rotation vectors of the joints, ``[T, 66]``."""
    wanted = 3 * len(JOINTS)
    if "poses" in content:
        poses = table(file, "poses", _flat(content["poses"], 1), -1)
        if poses.shape[1] < wanted:
            raise UserError(f"{file}: poses have {poses.shape[1]} columns, expected {wanted} or more, three per joint")
        return poses[:, :wanted]
    root, body = _key(content, ROOT), _key(content, BODY)
    parts = [table(file, root, content[root], 3), table(file, body, content[body], -1)]
    if len(parts[0]) != len(parts[1]) or parts[1].shape[1] < wanted - 3:
        raise UserError(
            f"{file}: {root} of shape {parts[0].shape} and {body} of shape {parts[1].shape}, expected (T, 3) and "
            f"(T, {wanted - 3})"
        )
    return np.concatenate([parts[0], parts[1][:, : wanted - 3]], axis=1)


def _key(content: Mapping, names: Sequence[str]) -> str:
    """The first of the names that the file has, or nothing."""
    return next((name for name in names if name in content), "")


def _flat(value, kept: int):
    """An array with all axes after the first ``kept`` in one, ``[..., N]``; anything else as it is."""
    if not isinstance(value, np.ndarray) or value.ndim < kept:
        return value
    return value.reshape(*value.shape[:kept], math.prod(value.shape[kept:]))


def _text(file: Path, content: Mapping, name: str) -> str:
    """A word that the file has, or nothing: an old file has it as bytes, which no one needs."""
    if isinstance(content.get(name), str):
        return content[name][:20]
    try:
        return "".join(texts(file, name, content[name]))[:20] if name in content else ""
    except UserError:
        return ""


def _opened(model: Path):
    try:
        return model.open("rb")
    except OSError as error:
        raise UserError(f"cannot read {model}: {error.strerror or error}") from error
