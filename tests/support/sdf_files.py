"""SDF texts for tests, and where example-robot-data keeps Cassie."""

from __future__ import annotations

from pathlib import Path

import pinocchio as pin

CASSIES = (
    "cassie",
    "cassie_reduced",
    "cassie_simple",
    "cassie_v2",
    "cassie_wo_gearbox_spring",
)


def cassie(name: str) -> Path:
    """Path of one of the Cassie files, which are installed under Pinocchio's prefix."""
    below = Path("share/example-robot-data/robots/cassie_description/robots") / f"{name}.sdf"
    return next(
        prefix / below for prefix in Path(pin.__file__).parents if (prefix / below).exists()
    )


def link(
    name: str, pose: str = "", mass: float = 1.0, com: str = "0 0 0 0 0 0", more: str = ""
) -> str:
    """A link whose inertia is 0.01 times its mass, about each axis."""
    moment = 0.01 * mass
    return f"""<link name="{name}">{f"<pose>{pose}</pose>" if pose else ""}
      <inertial><pose>{com}</pose><mass>{mass}</mass>
        <inertia><ixx>{moment}</ixx><iyy>{moment}</iyy><izz>{moment}</izz>
          <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial></link>
"""


def joint(
    name: str, kind: str, parent: str, child: str, inside: str = "", axis: str = "0 1 0"
) -> str:
    """A joint with one axis; ``inside`` stands in the joint, and after ``|`` in the axis."""
    own, _, in_axis = inside.partition("|")
    axes = f"<axis><xyz>{axis}</xyz>{in_axis}</axis>" if axis else ""
    return f"""<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>
      {own}{axes}</joint>
"""


def sdf(*parts: str, version: str = "1.9", name: str = "robot") -> str:
    """A file with one model."""
    return f'<?xml version="1.0"?>\n<sdf version="{version}"><model name="{name}">\n' + (
        "".join(parts) + "</model></sdf>\n"
    )


def four_bar(extra: str = "", closing: str = "") -> str:
    """A parallelogram in the x-z plane on the ground: crank, coupler, rocker of unit length.

    ``extra`` stands in the model, ``closing`` in the joint between coupler and rocker (``|`` as
    in :func:`joint`).
    """
    return sdf(
        link("crank", "0 0 0 0 0 0", com="0 0 0.5 0 0 0"),
        link("coupler", "0 0 1 0 0 0", com="0.5 0 0 0 0 0"),
        link("rocker", "1 0 0 0 0 0", com="0 0 0.5 0 0 0"),
        joint("a", "revolute", "world", "crank"),
        joint("b", "revolute", "crank", "coupler"),
        joint("d", "revolute", "world", "rocker"),
        joint("c", "revolute", "coupler", "rocker", "<pose>0 0 1 0 0 0</pose>" + closing),
        extra,
        name="four_bar",
    )
