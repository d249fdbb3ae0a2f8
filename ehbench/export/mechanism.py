"""The mechanism alone, with its inertias, as URDF and MJCF.

A link's frame is its joint's frame turned with it: z along the axis (standard Denavit–Hartenberg:
``Rot_z(theta + q) Trans_z(d) Trans_x(a) Rot_x(alpha)``). z of the world points up."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from ehbench.config.rig import Rig
from ehbench.export.component import distinct
from ehbench.plant.model import Model


@dataclass(frozen=True)
class Body:
    """A moving body: its joint's frame in that of the body before (position [m], rotation matrix),
    the joint's ``axis`` there and whether it ``slides``, its damping [N·m·s/rad or N·s/m] and
    range [rad or m], None without a cylinder; mass [kg], centre of mass [m] and inertia about it
    [kg·m²] along the axes of this frame."""

    name: str
    position: np.ndarray
    rotation: np.ndarray
    axis: tuple[float, float, float]
    slides: bool
    damping: float
    ends: tuple[float, float] | None
    mass: float
    com: np.ndarray
    inertia: np.ndarray


def _about_x(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def bodies_of(rig: Rig) -> Iterator[Body]:
    """The bodies of a rig's mechanism, base first."""
    model, mechanism = Model.of(rig), rig.mechanism
    names = distinct(["world", *rig.joint_names])[1:]  # MuJoCo has one world of its own
    ends: dict[int, tuple[float, float]] = {}
    for i, row in enumerate(model.plant.cylinders):
        low, high = sorted(model.stroke_range(i))
        ends[int(row.joint)] = low, high
    if mechanism.kind == "slide":
        slope = float(mechanism.incline)
        axis = math.cos(slope), 0.0, math.sin(slope)
        # it never turns, so that its inertia is of no effect
        facts = float(mechanism.mass), np.zeros(3), np.eye(3)
        damping = float(mechanism.damping)
        yield Body(names[0], np.zeros(3), np.eye(3), axis, True, damping, ends.get(0), *facts)
        return
    position = np.zeros(3)
    twist = np.eye(3) if mechanism.first_axis == "vertical" else _about_x(0.5 * math.pi)
    for i, joint in enumerate(mechanism.joint):
        c, s = math.cos(float(joint.dh_theta)), math.sin(float(joint.dh_theta))
        rotation = twist @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        twist, end = _about_x(float(joint.dh_alpha)), np.array([joint.dh_a, 0.0, joint.dh_d], float)
        xx, yy, zz, xy, xz, yz = joint.inertia.value
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        yield Body(
            names[i],
            position,
            rotation,
            (0.0, 0.0, 1.0),
            False,
            float(joint.joint_damping),
            ends.get(i),
            float(joint.mass),
            twist @ np.array(joint.com.value) + end,
            twist @ tensor @ twist.T,
        )
        position = end


def _text(*values: float) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)


def _xml_bytes(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def urdf(rig: Rig) -> bytes:
    """The mechanism of a rig as URDF."""
    root = ElementTree.Element("robot", name=rig.name)
    bodies = list(bodies_of(rig))
    parent = distinct([*(body.name for body in bodies), "base"])[-1]
    ElementTree.SubElement(root, "link", name=parent)
    for body in bodies:
        link = ElementTree.SubElement(root, "link", name=body.name)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=_text(*body.com), rpy="0 0 0")
        ElementTree.SubElement(inertial, "mass", value=_text(body.mass))
        names = {f"i{'xyz'[i]}{'xyz'[k]}": (i, k) for i in range(3) for k in range(i, 3)}
        tensor = {name: _text(body.inertia[at]) for name, at in names.items()}
        ElementTree.SubElement(inertial, "inertia", tensor)
        kind = "prismatic" if body.slides else "revolute" if body.ends else "continuous"
        joint = ElementTree.SubElement(root, "joint", name=f"{body.name}_joint", type=kind)
        r = body.rotation
        flat = math.hypot(r[0, 0], r[1, 0])
        rpy = (
            (math.atan2(r[2, 1], r[2, 2]), math.atan2(-r[2, 0], flat), math.atan2(r[1, 0], r[0, 0]))
            if flat > 1e-9
            else (math.atan2(-r[1, 2], r[1, 1]), math.atan2(-r[2, 0], flat), 0.0)
        )
        ElementTree.SubElement(joint, "origin", xyz=_text(*body.position), rpy=_text(*rpy))
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=body.name)
        ElementTree.SubElement(joint, "axis", xyz=_text(*body.axis))
        ElementTree.SubElement(joint, "dynamics", damping=_text(body.damping))
        if body.ends:
            low, high = map(_text, body.ends)
            # effort and speed are the hydraulics' affair; URDF asks for a number
            limit = {"lower": low, "upper": high, "effort": "1e9", "velocity": "1e3"}
            ElementTree.SubElement(joint, "limit", limit)
        parent = body.name
    return _xml_bytes(root)


def mjcf(rig: Rig) -> bytes:
    """The mechanism of a rig as MJCF, for MuJoCo."""
    root = ElementTree.Element("mujoco", model=rig.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    ElementTree.SubElement(root, "option", gravity=_text(0.0, 0.0, -float(rig.gravity)))
    place = ElementTree.SubElement(root, "worldbody")
    for body in bodies_of(rig):
        axes = _text(*body.rotation[:, 0], *body.rotation[:, 1])
        place = ElementTree.SubElement(
            place, "body", name=body.name, pos=_text(*body.position), xyaxes=axes
        )
        joint = {"name": f"{body.name}_joint", "type": "slide" if body.slides else "hinge"}
        joint |= {"axis": _text(*body.axis), "damping": _text(body.damping)}
        joint |= {"range": _text(*body.ends)} if body.ends else {}
        ElementTree.SubElement(place, "joint", joint)
        full = (body.inertia[i, k] for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        mass = {"pos": _text(*body.com), "mass": _text(body.mass), "fullinertia": _text(*full)}
        ElementTree.SubElement(place, "inertial", mass)
    return _xml_bytes(root)
