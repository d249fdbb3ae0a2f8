"""Equations of motion of a serial chain of any number of revolute joints, or of one sliding mass;
compiled.

Frames are standard Denavit–Hartenberg (thesis 2.2, Fu, Gonzalez & Lee): frame i sits at the end of
link i and ``T_i = Rot_z(theta0_i + q_i) Trans_z(d_i) Trans_x(a_i) Rot_x(alpha_i)``. Which way is up
in the base frame is said by ``gravity``. A slide is one coordinate q = x along an incline, uphill
positive.

Inside, link i is described in its joint frame: origin on joint axis i, z along it, turned with the
link. There the axis is (0, 0, 1), the next joint lies at (a, 0, d) and mass, first moment and
inertia about the origin are constants, in which all the equations are linear. `pack_link` puts
link-end values into that form, one row of ``links`` a link.

Kernels share their leading arguments: ``kind`` CHAIN or SLIDE; ``links`` records of LINK (n,);
``gravity`` float64 (3,), g times the base-frame direction that points up [m/s²] (a slide takes its
last entry); ``q, qd, qdd, torque`` float64 (n,) [rad…, N·m], for a slide (1,) [m…, N]; ``work``
float64 (work_size(n),), overwritten. They allocate nothing, check nothing, and give inf or nan
where the mass matrix is singular."""

import math

import numpy as np

from ehbench.runtime.compiled import kernel, part_kernel, record

CHAIN, SLIDE = 0, 1

# A link, described in its joint frame: where the next joint lies (``a``, 0, ``d``) [m], the twist
# to it, the angle ``theta0`` at q = 0 [rad], ``mass`` [kg], first moment (hx, hy, hz) [kg·m] and
# inertia about the origin (jxx … jyz) [kg·m²], viscous ``damping`` [N·m·s/rad]. A slide has mass,
# damping [N·s/m] and, for its incline, cos_alpha and sin_alpha.
LINK = record(
    *((name, "f8") for name in "a d cos_alpha sin_alpha theta0 mass hx hy hz".split()),
    *((name, "f8") for name in "jxx jyy jzz jxy jxz jyz damping".split()),
)

# Work a joint: cosine and sine of its angle, then (force, moment) or the composite (mass, moments,
# inertia).
_COS, _SIN, _BODY = 0, 1, 2
_STRIDE = 12


def pack_link(dh_a, dh_d, dh_alpha, dh_theta, mass, com, inertia, damping) -> dict[str, float]:
    """One row of ``links`` for a revolute joint and its link, by the fields of LINK.

    Args:
        dh_a, dh_d: Denavit–Hartenberg link length and offset [m].
        dh_alpha, dh_theta: twist, and joint angle at q = 0 [rad].
        mass: [kg].
        com: centre of mass in the link-end frame [m], shape (3,).
        inertia: tensor about the centre of mass along the link-end axes [kg·m²], shape (3, 3),
            symmetric; its off-diagonal elements are those of the tensor, −∫xy dm.
        damping: viscous damping at the joint [N·m·s/rad].
    """
    cosine, sine = math.cos(dh_alpha), math.sin(dh_alpha)
    twist = np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])
    r = twist @ np.asarray(com, dtype=float) + (dh_a, 0.0, dh_d)
    j = twist @ np.asarray(inertia, dtype=float) @ twist.T + mass * (
        r @ r * np.eye(3) - np.outer(r, r)
    )
    frame = {"a": dh_a, "d": dh_d, "cos_alpha": cosine, "sin_alpha": sine, "theta0": dh_theta}
    moments = dict(zip(("hx", "hy", "hz"), mass * r, strict=True))
    squares = {"jxx": j[0, 0], "jyy": j[1, 1], "jzz": j[2, 2]}
    products = {"jxy": j[0, 1], "jxz": j[0, 2], "jyz": j[1, 2]}
    return frame | {"mass": mass, "damping": damping} | moments | squares | products


def pack_slide(mass, damping, incline) -> dict[str, float]:
    """The one row of ``links`` for a sliding mass, by the fields of LINK.

    Args:
        mass: [kg].
        damping: viscous damping [N·s/m].
        incline: slope [rad], positive when x grows uphill; π/2 lifts straight up.
    """
    slope = {"cos_alpha": math.cos(incline), "sin_alpha": math.sin(incline)}
    return {"mass": mass, "damping": damping, **slope}


@kernel
def work_size(n):
    """Length of the float64 workspace for n joints."""
    return n * (_STRIDE + n + 1)


@kernel
def _outward(c, s, ca, sa, x, y, z):
    """A vector in the axes of a joint frame, given in those of the joint before: Rz(θ)ᵀ Rx(α)ᵀ."""
    y, z = ca * y + sa * z, ca * z - sa * y
    return c * x + s * y, c * y - s * x, z


@kernel
def _inward(c, s, ca, sa, x, y, z):
    """The inverse of `_outward`: Rx(α) Rz(θ)."""
    x, y = c * x - s * y, s * x + c * y
    return x, ca * y - sa * z, sa * y + ca * z


@kernel
def turn_joint(links, i, q, work):
    """Cosine and sine of joint i at its coordinate q into ``work``."""
    angle = links[i].theta0 + q
    work[i * _STRIDE + _COS] = math.cos(angle)
    work[i * _STRIDE + _SIN] = math.sin(angle)


@kernel
def turn(links, q, work):
    """Cosine and sine of every joint angle into ``work``, for the kernels called ``…_turned``."""
    for i in range(links.shape[0]):
        turn_joint(links, i, q[i], work)


@kernel
def _newton_euler(links, gravity, qd, out, work):
    """Torque at rest acceleration, after `turn`: rates outward, then forces inward."""
    n = links.shape[0]
    # (w, e, a): angular rate, angular acceleration, acceleration of the origin; gravity as a base
    # that accelerates up.
    wx, wy, wz, ex, ey, ez = 0.0, 0.0, qd[0], 0.0, 0.0, 0.0
    ax, ay, az = _outward(work[_COS], work[_SIN], 1.0, 0.0, gravity[0], gravity[1], gravity[2])
    for i in range(n):
        b = i * _STRIDE
        m, hx, hy, hz = links[i].mass, links[i].hx, links[i].hy, links[i].hz
        jxx, jyy, jzz = links[i].jxx, links[i].jyy, links[i].jzz
        jxy, jxz, jyz = links[i].jxy, links[i].jxz, links[i].jyz
        # k = [e]× + [w]×[w]×, so that a point r fixed to the link accelerates by a + k r
        xx, yy, zz, xy, xz, yz = wx * wx, wy * wy, wz * wz, wx * wy, wx * wz, wy * wz
        k00, k01, k02 = -yy - zz, xy - ez, xz + ey
        k10, k11, k12 = xy + ez, -xx - zz, yz - ex
        k20, k21, k22 = xz - ey, yz + ex, -xx - yy
        work[b + _BODY] = m * ax + k00 * hx + k01 * hy + k02 * hz
        work[b + _BODY + 1] = m * ay + k10 * hx + k11 * hy + k12 * hz
        work[b + _BODY + 2] = m * az + k20 * hx + k21 * hy + k22 * hz
        lx, ly, lz = (
            jxx * wx + jxy * wy + jxz * wz,
            jxy * wx + jyy * wy + jyz * wz,
            jxz * wx + jyz * wy + jzz * wz,
        )
        work[b + _BODY + 3] = jxx * ex + jxy * ey + jxz * ez + wy * lz - wz * ly + hy * az - hz * ay
        work[b + _BODY + 4] = jxy * ex + jyy * ey + jyz * ez + wz * lx - wx * lz + hz * ax - hx * az
        work[b + _BODY + 5] = jxz * ex + jyz * ey + jzz * ez + wx * ly - wy * lx + hx * ay - hy * ax
        if i + 1 < n:
            pa, pd, ca, sa = links[i].a, links[i].d, links[i].cos_alpha, links[i].sin_alpha
            c, s, rate = work[b + _STRIDE + _COS], work[b + _STRIDE + _SIN], qd[i + 1]
            ax, ay, az = (
                ax + k00 * pa + k02 * pd,
                ay + k10 * pa + k12 * pd,
                az + k20 * pa + k22 * pd,
            )
            ax, ay, az = _outward(c, s, ca, sa, ax, ay, az)
            wx, wy, wz = _outward(c, s, ca, sa, wx, wy, wz)
            ex, ey, ez = _outward(c, s, ca, sa, ex, ey, ez)
            ex, ey, wz = ex + wy * rate, ey - wx * rate, wz + rate
    _sum_inward(links, qd, out, work)


@part_kernel
def _sum_inward(links, qd, out, work):
    """Torques from each link's own force and moment in ``work``, which are summed from the tip."""
    for i in range(links.shape[0] - 1, -1, -1):
        b = i * _STRIDE
        out[i] = work[b + _BODY + 5] + links[i].damping * qd[i]
        if i > 0:
            link, own = links[i - 1], work[b + _BODY : b + _BODY + 6]
            pa, pd, ca, sa = link.a, link.d, link.cos_alpha, link.sin_alpha
            c, s, p = work[b + _COS], work[b + _SIN], b - _STRIDE + _BODY
            fx, fy, fz = _inward(c, s, ca, sa, own[0], own[1], own[2])
            nx, ny, nz = _inward(c, s, ca, sa, own[3], own[4], own[5])
            work[p] += fx
            work[p + 1] += fy
            work[p + 2] += fz
            work[p + 3] += nx - pd * fy
            work[p + 4] += ny + pd * fx - pa * fz
            work[p + 5] += nz + pa * fy


@kernel
def _composite(links, first, work):
    """Lower triangle of the mass matrix of the joints from ``first`` on at the tail of ``work``."""
    n = links.shape[0]
    tail = n * _STRIDE
    m, hx, hy, hz, jxx, jyy, jzz, jxy, jxz, jyz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n - 1, first - 1, -1):
        # (m, h, j) is what hangs outside of link i, about joint i's origin
        m += links[i].mass
        hx += links[i].hx
        hy += links[i].hy
        hz += links[i].hz
        jxx += links[i].jxx
        jyy += links[i].jyy
        jzz += links[i].jzz
        jxy += links[i].jxy
        jxz += links[i].jxz
        jyz += links[i].jyz
        work[tail + i * n + i] = jzz
        # force and moment of a unit acceleration of joint i, felt at each joint inward
        fx, fy, fz, nx, ny, nz = -hy, hx, 0.0, jxz, jyz, jzz
        for k in range(i - 1, first - 1, -1):
            b = (k + 1) * _STRIDE
            pa, pd, ca, sa = links[k].a, links[k].d, links[k].cos_alpha, links[k].sin_alpha
            c, s = work[b + _COS], work[b + _SIN]
            fx, fy, fz = _inward(c, s, ca, sa, fx, fy, fz)
            nx, ny, nz = _inward(c, s, ca, sa, nx, ny, nz)
            nx, ny, nz = nx - pd * fy, ny + pd * fx - pa * fz, nz + pa * fy
            work[tail + i * n + k] = nz
        if i > first:
            b = i * _STRIDE
            c, s, pa, pd = work[b + _COS], work[b + _SIN], links[i - 1].a, links[i - 1].d
            ca, sa = links[i - 1].cos_alpha, links[i - 1].sin_alpha
            hx, hy, hz = _inward(c, s, ca, sa, hx, hy, hz)
            # Rz j Rzᵀ, then Rx (…) Rxᵀ
            shift = s * (s * (jxx - jyy) + 2.0 * c * jxy)
            jxy = c * s * (jxx - jyy) + (c * c - s * s) * jxy
            jxx, jyy = jxx - shift, jyy + shift
            jxz, jyz = c * jxz - s * jyz, s * jxz + c * jyz
            shift = sa * (sa * (jyy - jzz) + 2.0 * ca * jyz)
            jyz = ca * sa * (jyy - jzz) + (ca * ca - sa * sa) * jyz
            jyy, jzz = jyy - shift, jzz + shift
            jxy, jxz = ca * jxy - sa * jxz, sa * jxy + ca * jxz
            # about joint i−1 instead of joint i, (a, 0, d) further in; then the first moment alike
            ux, uz = 2.0 * hx + m * pa, 2.0 * hz + m * pd
            jxx += pd * uz
            jyy += pd * uz + pa * ux
            jzz += pa * ux
            jxy -= pa * hy
            jxz -= pa * hz + pd * hx + m * pa * pd
            jyz -= pd * hy
            hx += m * pa
            hz += m * pd
    return tail


@kernel
def bias_turned(kind, links, gravity, qd, out, work):
    """Write h(q, q̇) + c(q) + B q̇ in the posture of `turn` into ``out`` (n,): the torque [N·m], or
    force [N] of a slide, that holds q̈ = 0.

    Recursive Newton–Euler; with the mass matrix D(q), ``D q̈ + h + c + B q̇ = τ`` (thesis 2.2)."""
    if kind == SLIDE:
        out[0] = links[0].mass * gravity[2] * links[0].sin_alpha + links[0].damping * qd[0]
        return
    _newton_euler(links, gravity, qd, out, work)


@kernel
def mass_matrix(kind, links, q, out, work):
    """Write D(q) into ``out`` (n, n) [kg·m²], or [kg]; composite rigid bodies."""
    turn(links, q, work)
    mass_matrix_turned(kind, links, out, work)


@kernel
def mass_matrix_turned(kind, links, out, work):
    """`mass_matrix` in the posture of `turn`."""
    if kind == SLIDE:
        out[0, 0] = links[0].mass
        return
    tail, n = _composite(links, 0, work), links.shape[0]
    for i in range(n):
        for k in range(i + 1):
            out[i, k] = out[k, i] = work[tail + i * n + k]


@kernel
def inertia_turned(kind, links, j, work):
    """D_jj(q) of a joint [kg·m²] or [kg], in the posture of `turn`; q_j does not matter."""
    if kind == SLIDE:
        return links[0].mass
    return work[_composite(links, j, work) + j * links.shape[0] + j]


@kernel
def forward(kind, links, gravity, q, qd, drive, qdd, work):
    """Write the acceleration q̈ = (D + diag(added))⁻¹ (τ − h − c − B q̇) into ``qdd`` (n,) [rad/s²],
    or [m/s²] of a slide.

    ``drive`` (2n,) holds τ, what drives the joints beside gravity and joint damping, then inertia
    added about each [kg·m²], or [kg]; ``qdd`` may be its first half."""
    if kind == SLIDE:
        m, weight = links[0].mass, links[0].mass * gravity[2] * links[0].sin_alpha
        qdd[0] = (drive[0] - links[0].damping * qd[0] - weight) / (m + drive[1])
        return
    n = links.shape[0]
    turn(links, q, work)
    rest = n * (_STRIDE + n)
    _newton_euler(links, gravity, qd, work[rest:], work)
    tail = _composite(links, 0, work)
    # D = L diag(p) Lᵀ in place, the right-hand side solved along the way
    for i in range(n):
        row = tail + i * n
        value = drive[i] - work[rest + i]
        pivot = work[row + i] + drive[n + i]
        for k in range(i):
            element = work[row + k]
            for j in range(k):
                element -= work[row + j] * work[tail + k * n + j]
            work[row + k] = element
        for k in range(i):
            element = work[row + k]
            factor = element * work[tail + k * n + k]
            pivot -= factor * element
            value -= factor * qdd[k]
            work[row + k] = factor
        work[row + i] = 1.0 / pivot
        qdd[i] = value
    for i in range(n - 1, -1, -1):
        value = qdd[i] * work[tail + i * n + i]
        for k in range(i + 1, n):
            value -= work[tail + k * n + i] * qdd[k]
        qdd[i] = value


@kernel
def gravity_torque(kind, links, gravity, q, out, work):
    """Write c(q) into ``out`` (n,): the torque [N·m], or force [N] of a slide, that holds the links
    at rest.

    ``c = ∂PE/∂q``: the moment of all that hangs outside of a joint, in that joint's frame."""
    turn(links, q, work)
    plumb(kind, links, gravity, work)
    weigh_turned(kind, links, gravity, 0, out, work)


@kernel
def plumb(kind, links, gravity, work):
    """Up direction times g in every joint's frame into ``work``, after `turn`."""
    if kind == SLIDE:
        return
    ux, uy, uz = _outward(work[_COS], work[_SIN], 1.0, 0.0, gravity[0], gravity[1], gravity[2])
    for i in range(links.shape[0]):
        b = i * _STRIDE
        if i > 0:
            ca, sa = links[i - 1].cos_alpha, links[i - 1].sin_alpha
            ux, uy, uz = _outward(work[b + _COS], work[b + _SIN], ca, sa, ux, uy, uz)
        work[b + _BODY] = ux
        work[b + _BODY + 1] = uy


@kernel
def weigh_turned(kind, links, gravity, first, out, work):
    """`gravity_torque` of the joints from ``first`` on, in the posture of `turn`, after `plumb`."""
    if kind == SLIDE:
        out[0] = links[0].mass * gravity[2] * links[0].sin_alpha
        return
    m, hx, hy, hz = 0.0, 0.0, 0.0, 0.0
    for i in range(links.shape[0] - 1, first - 1, -1):
        b = i * _STRIDE
        m, hx, hy, hz = m + links[i].mass, hx + links[i].hx, hy + links[i].hy, hz + links[i].hz
        out[i] = hx * work[b + _BODY + 1] - hy * work[b + _BODY]
        if i > first:
            ca, sa = links[i - 1].cos_alpha, links[i - 1].sin_alpha
            hx, hy, hz = _inward(work[b + _COS], work[b + _SIN], ca, sa, hx, hy, hz)
            hx += m * links[i - 1].a
            hz += m * links[i - 1].d


@kernel
def energy(kind, links, gravity, q, qd, work):
    """(kinetic, potential) energy [J]; potential from the base, or x = 0 of a slide."""
    if kind == SLIDE:
        m = links[0].mass
        return 0.5 * m * qd[0] * qd[0], m * gravity[2] * q[0] * links[0].sin_alpha
    n = links.shape[0]
    turn(links, q, work)
    kinetic, potential, height = 0.0, 0.0, 0.0
    wx, wy, wz, vx, vy, vz = 0.0, 0.0, qd[0], 0.0, 0.0, 0.0
    ux, uy, uz = _outward(work[_COS], work[_SIN], 1.0, 0.0, gravity[0], gravity[1], gravity[2])
    for i in range(n):
        link = links[i]
        m, hx, hy, hz = link.mass, link.hx, link.hy, link.hz
        spin = link.jxx * wx * wx + link.jyy * wy * wy + link.jzz * wz * wz
        spin += 2.0 * (link.jxy * wx * wy + link.jxz * wx * wz + link.jyz * wy * wz)
        mixed = vx * (wy * hz - wz * hy) + vy * (wz * hx - wx * hz) + vz * (wx * hy - wy * hx)
        kinetic += 0.5 * (m * (vx * vx + vy * vy + vz * vz) + spin) + mixed
        potential += m * height + ux * hx + uy * hy + uz * hz
        if i + 1 < n:
            b, pa, pd, ca, sa = (i + 1) * _STRIDE, link.a, link.d, link.cos_alpha, link.sin_alpha
            c, s = work[b + _COS], work[b + _SIN]
            height += ux * pa + uz * pd
            vx, vy, vz = _outward(c, s, ca, sa, vx + wy * pd, vy + wz * pa - wx * pd, vz - wy * pa)
            wx, wy, wz = _outward(c, s, ca, sa, wx, wy, wz)
            ux, uy, uz = _outward(c, s, ca, sa, ux, uy, uz)
            wz += qd[i + 1]
    return kinetic, potential
