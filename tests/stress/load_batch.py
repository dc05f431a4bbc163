"""Child process: load the descriptions named on standard input, and say what became of each.

One path per line in; one JSON object per line out, flushed, so that a crash loses nothing.
"""

from __future__ import annotations

import json
import sys
import warnings
from typing import Any

import numpy as np
import pinocchio as pin

import srm_mbs as srm
from srm_mbs.dynamics.constraints.rows import LoopKinematics
from srm_mbs.dynamics.forces import ForceKinematics


def fingerprint(mechanism: srm.Mechanism) -> dict[str, Any]:
    """What a mechanism is, in numbers: tree, loops, start, defaults, names."""
    model = mechanism.model
    data = model.createData()
    rng = np.random.default_rng(0)
    rows = LoopKinematics(model, mechanism.loops)
    forces = ForceKinematics(model, mechanism.forces)
    tree: list[Any] = [joint.shortname() for joint in model.joints]
    loops: list[Any] = []
    for _ in range(3):
        q = pin.integrate(model, pin.neutral(model), rng.uniform(-1.5, 1.5, model.nv))
        v = rng.standard_normal(model.nv)
        pin.crba(model, data, q, pin.Convention.WORLD)
        pin.nonLinearEffects(model, data, q, v)
        rows.update(data, q, v)
        force = data.nle + model.damping * v + model.friction * np.tanh(v)
        force -= forces.generalised(data, q, v, 0.0)
        tree += [np.triu(data.M).ravel().tolist(), force.tolist()]
        loops += [rows.g.tolist(), rows.G.ravel().tolist(), rows.bias.tolist()]
    defaults = mechanism.defaults
    return {
        "tree": tree,
        "loops": loops,
        "start": [mechanism.q0.tolist(), mechanism.v0.tolist()],
        "defaults": [defaults.t_end, defaults.rtol, defaults.atol],
        "names": [mechanism.name, mechanism.joint_names, [loop.name for loop in mechanism.loops]],
        "freedom": mechanism.degrees_of_freedom,
    }


def outcome(path: str) -> dict[str, Any]:
    """``loaded`` with fingerprint and remarks, ``refused`` with the message, or ``raised``."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            mechanism = srm.load(path)
            result = {"is": "loaded", **fingerprint(mechanism)}
        except srm.InputError as error:
            return {"is": "refused", "message": str(error), "file": error.file}
        except Exception as error:
            return {"is": "raised", "message": f"{type(error).__name__}: {error}"}
    alien = [str(w.message) for w in caught if not issubclass(w.category, srm.SrmWarning)]
    if alien:
        return {"is": "raised", "message": f"a warning that is not ours: {alien[0]}"}
    return {**result, "remarks": len(mechanism.notes) + len(caught)}


def main() -> None:
    for line in sys.stdin:
        path = line.strip()
        print(json.dumps({"path": path, **outcome(path)}), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
