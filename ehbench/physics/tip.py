"""Where the tip of a mechanism is, and joint coordinates that bring it somewhere.

The tip is the end of the last link, where a slide's mass is. It is told in a frame that stands on
the ground: x ahead (the base frame's x), y to the left, z up [m]; frames of the links as in
`ehbench.physics.arm`."""

from typing import Any, NamedTuple

import numpy as np

from ehbench.physics.arm import SLIDE

FOUND = 1.0e-8  # [m] from the target at which the tip is there
STILL = 1.0e-9  # [rad or m] of a step with which the search stands
NEWTON = 12  # steps of many points at once, at most
TURNS = 200  # of the search, at most
_FRAME = ["a", "d", "cos_alpha", "sin_alpha", "theta0"]  # what of a link says where the next is
LIGHT, HEAVY = 1.0e-10, 1.0e4  # damping [m²] with which it begins, at which it gives up


class Chain(NamedTuple):
    """``kind``, ``links``, ``gravity`` as in `ehbench.physics.arm`, ends of joint ranges, shape
    (n,)."""

    kind: int
    links: Any
    gravity: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Found(NamedTuple):
    """Result of a search: coordinates ``q``, distance to the target [m], ends that hold it back
    (±1)."""

    q: np.ndarray
    miss: float
    beyond: np.ndarray

    @property
    def there(self) -> bool:
        """Whether the tip is at the target."""
        return self.miss <= FOUND


def _ground(gravity: np.ndarray) -> np.ndarray:
    """Rows: x, y and z of the frame on the ground, in the base frame."""
    size = float(np.linalg.norm(gravity))
    x, y, z = (gravity / size).tolist() if size > 0.0 else (0.0, 0.0, 1.0)
    return np.array([[1.0, 0.0, 0.0], [0.0, z, -y], [x, y, z]])  # left is up × ahead


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b of vectors in the last axis; for a few of them in a quarter of `numpy.cross`'s time."""
    built = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        built[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return built


class Frames(NamedTuple):
    """At some postures: the ``tip`` [m], shape (…, 3), ``axes`` and ``origins`` [m], shape (…, n,
    3)."""

    tip: np.ndarray
    axes: np.ndarray
    origins: np.ndarray


def tip_frames(chain: Chain, q: np.ndarray) -> Frames:
    """The `Frames` at joint coordinates of shape (…, n)."""
    q = np.asarray(q, float)
    ground = _ground(chain.gravity)
    if chain.kind == SLIDE:
        link = chain.links[0]
        way = np.array([link.cos_alpha, 0.0, link.sin_alpha])
        tip = q[..., :1] * way
        return Frames(tip, np.broadcast_to(way, (*q.shape, 3)), np.zeros((*q.shape, 3)))
    turn = np.broadcast_to(ground, (*q.shape[:-1], 3, 3))
    place = np.zeros((*q.shape[:-1], 3))
    axes, origins = np.empty((*q.shape, 3)), np.empty((*q.shape, 3))
    for i, (a, d, ca, sa, theta0) in enumerate(np.asarray(chain.links)[_FRAME].tolist()):
        axes[..., i, :], origins[..., i, :] = turn[..., :, 2], place
        angle = theta0 + q[..., i]
        c, s = np.cos(angle), np.sin(angle)
        offset = np.empty((*angle.shape, 3))
        for row, value in enumerate((a * c, a * s, d)):
            offset[..., row] = value
        place = place + np.einsum("...ij,...j->...i", turn, offset)
        if i + 1 == q.shape[-1]:
            break
        local = np.empty((*angle.shape, 3, 3))
        local[..., 0, 0], local[..., 0, 1], local[..., 0, 2] = c, -s * ca, s * sa
        local[..., 1, 0], local[..., 1, 1], local[..., 1, 2] = s, c * ca, -c * sa
        local[..., 2, 0], local[..., 2, 1], local[..., 2, 2] = 0.0, sa, ca
        turn = turn @ local
    return Frames(place, axes, origins)


def tip_of(chain: Chain, q: np.ndarray) -> np.ndarray:
    """The tip [m], shape (…, 3), at coordinates (…, n): a quarter of the work of `tip_frames`."""
    q = np.asarray(q, float)
    if chain.kind == SLIDE:
        return tip_frames(chain, q).tip
    x = y = z = np.zeros(q.shape[:-1])
    frames = np.asarray(chain.links)[_FRAME].tolist()
    for i, (a, d, ca, sa, theta0) in reversed(list(enumerate(frames))):
        angle = theta0 + q[..., i]
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = x + a, ca * y - sa * z, sa * y + ca * z + d
        x, y = c * x - s * y, s * x + c * y
    tip = np.empty((*q.shape[:-1], 3))
    for row, (ahead, left, up) in enumerate(_ground(chain.gravity).tolist()):
        tip[..., row] = ahead * x + left * y + up * z
    return tip


def tip_jacobian(chain: Chain, frames: Frames) -> np.ndarray:
    """∂tip/∂q [m/rad], or [1] of a slide, shape (3, n), at one posture, of which ``frames`` are."""
    tip, axes, origins = frames
    return axes.T.copy() if chain.kind == SLIDE else _cross(axes, tip - origins).T


def reach(chain: Chain, target: np.ndarray, start: np.ndarray, free: np.ndarray) -> Found:
    """The joint coordinates that bring the tip to a target or, where it is out of reach, as near as
    the search from ``start`` gets.

    Damped least squares (Levenberg–Marquardt) on the joints that are ``free``, within their ranges:
    a joint at an end that the step would take it beyond is held there for that step.

    Args:
        target: [m], shape (3,).
        start: joint coordinates to start at, which also decide among several postures, shape (n,).
        free: True for the joints that may move."""
    q = np.where(free, np.clip(start, chain.low, chain.high), start)
    frames = tip_frames(chain, q)
    error, damping = target - frames.tip, LIGHT
    for _ in range(TURNS):
        if np.linalg.norm(error) <= FOUND or damping > HEAVY:
            break
        jacobian = tip_jacobian(chain, frames) * free
        step = _step(chain, q, jacobian, error, damping)
        if np.abs(step).max() < STILL:
            break
        tried = np.clip(q + step, np.minimum(chain.low, q), np.maximum(chain.high, q))
        there = tip_frames(chain, tried)
        left = target - there.tip
        if np.linalg.norm(left) < np.linalg.norm(error):
            q, frames, error, damping = tried, there, left, max(0.1 * damping, 1e-3 * LIGHT)
        else:
            damping *= 10.0
    pull = (tip_jacobian(chain, frames) * free).T @ error
    beyond = np.where((q >= chain.high) & (pull > 0.0), 1, 0)
    beyond -= (q <= chain.low) & (pull < 0.0)
    return Found(q, float(np.linalg.norm(error)), beyond)


def polish(
    chain: Chain, targets: np.ndarray, starts: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(joint coordinates, shape (points, n), miss [m]) of many targets at once, each from a start
    that is near already: Newton's steps, the shortest in the joints, ranges left aside.

    Args:
        targets: [m], shape (points, 3).
        starts: shape (points, n).
        free: True for the joints that may move."""
    q = starts.copy()
    for _ in range(NEWTON):
        tip, axes, origins = tip_frames(chain, q)
        error = targets - tip
        if np.linalg.norm(error, axis=1).max() <= FOUND:
            break
        rows = axes if chain.kind == SLIDE else _cross(axes, tip[:, None] - origins)
        rows = rows * free[:, None]
        square = np.einsum("pia,pib->pab", rows, rows) + LIGHT * np.eye(3)
        weight = np.linalg.solve(square, error[..., None])[..., 0]
        q = q + np.einsum("pia,pa->pi", rows, weight)
    return q, np.linalg.norm(targets - tip_of(chain, q), axis=1)


def _step(
    chain: Chain, q: np.ndarray, jacobian: np.ndarray, error: np.ndarray, damping: float
) -> np.ndarray:
    """A damped step from q; joints that it would take out of their range from an end are held."""
    fixed = np.zeros(q.size, bool)
    for _ in range(q.size + 1):
        moving = jacobian * ~fixed
        square = moving @ moving.T + damping * np.eye(3)
        step = moving.T @ np.linalg.solve(square, error)
        out = ((q >= chain.high) & (step > 0.0)) | ((q <= chain.low) & (step < 0.0))
        if not (out & ~fixed).any():
            return step
        fixed |= out
    return np.zeros(q.size)
