"""A four-bar with its loop in the URDF itself, in the form of URDF+.

Pinocchio's own reader ignores <loop>.  srm.load makes it a closure, and srm.convert writes the same
mechanism as a plain URDF and a TOML description.
"""

from pathlib import Path

import srm_mbs as srm

BAR = """
  <link name="{name}"><inertial>
    <origin xyz="{half} 0 0"/><mass value="{length}"/>
    <inertia ixx="1e-3" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
  <joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/>
    <origin xyz="{at} 0 0"/><axis xyz="0 -1 0"/>
    <limit lower="-100" upper="100" effort="1" velocity="1"/></joint>"""
LOOP = """
  <loop name="tip" type="revolute">
    <predecessor link="coupler"><origin xyz="2 0 0"/></predecessor>
    <successor link="rocker"><origin xyz="1.5 0 0"/></successor>
    <axis xyz="0 -1 0"/>
  </loop>"""


def bar(name: str, parent: str, at: float, length: float) -> str:
    """A uniform bar of 1 kg/m on a hinge."""
    moment = length**3 / 12.0
    return BAR.format(
        name=name, parent=parent, at=at, length=length, half=length / 2.0, moment=moment
    )


links = bar("crank", "world", 0.0, 1.0) + bar("coupler", "crank", 1.0, 2.0)
links += bar("rocker", "world", 2.2, 1.5)
path = Path("four_bar_with_loop.urdf")
path.write_text(f'<robot name="four_bar">\n  <link name="world"/>{links}{LOOP}\n</robot>\n')

mechanism = srm.load(path)
print("read:", [f"{loop.name} ({loop.type})" for loop in mechanism.loops])
print("degrees of freedom:", mechanism.degrees_of_freedom)
print("redundant rows:", ", ".join(mechanism.redundant_rows))

start = srm.assemble(mechanism, {"crank": 1.0}, {"crank": 4.0})
solution = srm.simulate(mechanism, 5.0, q0=start.q, v0=start.v)
print(f"largest drift {solution.drift[:, 0].max():.0e} m")

srm.convert(path, "four_bar_converted.toml")
again = srm.load("four_bar_converted.toml")
print("converted:", [loop.name for loop in again.loops], "and loaded again")
