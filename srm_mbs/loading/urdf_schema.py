"""Elements and attributes of URDF: what is read, what is ignored knowingly, what is refused."""

from __future__ import annotations

LOOP_ELEMENTS = ("loop_joint", "loop", "constraint", "coupling")
IGNORED = {
    "robot": ("material", "transmission", "gazebo", "sensor", "ros2_control", "verbose"),
    "link": (
        "visual",
        "collision",
        "contact",
        "self_filter",
        "sensor",
        "self_collision_checking",
        "collision_checking",
        "surface",
        "kinematic",
        "gravity",
    ),
    "joint": ("safety_controller", "calibration", "joint_properties"),
}
READ = {
    "robot": ("link", "joint"),
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": (
        "origin",
        "parent",
        "child",
        "axis",
        "axis2",
        "thread_pitch",
        "limit",
        "dynamics",
    ),
}
ATTRIBUTES = {
    "link": ("name", "type"),
    "joint": ("name", "type", "dont_collapse"),
    "origin": ("xyz", "rpy"),
    "mass": ("value",),
    "inertia": ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
    "parent": ("link",),
    "child": ("link",),
    "axis": ("xyz",),
    "axis2": ("xyz",),
    "thread_pitch": ("value",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction", "armature"),
}
INFORMATIVE = {
    "joint": ("independent",),
    "limit": ("command_effort", "current", "gear_velocity"),
    "dynamics": ("D", "K", "mu_coulomb", "mu_viscous"),
}
"""Attributes of other tools found in published files: ignored, with a note."""
DRAWN_ONLY = ("material", "visual", "collision")
"""Elements whose loss needs no note: they do not act."""
