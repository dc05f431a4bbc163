"""The command line: exit status, messages, files, and what it prints."""

from __future__ import annotations

import csv
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import srm_mbs as srm
from srm_mbs.analysis.summary import joint_rows
from tests.cli.conftest import Describe
from tests.support.commands import ROOT, command, error_line, row, run, run_apart
from tests.support.urdf_files import tree
from tools.pages import DOCS, blocks

BOX = """<robot name="box"><link name="box"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
POSIX = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

# meshcat imports a module of pyzmq that warns.
pytestmark = pytest.mark.filterwarnings("ignore:zmq.eventloop:DeprecationWarning")


def started(*args: object) -> subprocess.Popen[str]:
    """A command that goes on beside the test, in a process that a signal interrupts."""
    return subprocess.Popen(
        command(*args),
        cwd=ROOT,
        env=os.environ | {"BROWSER": "true"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A test run in the background of a shell would ignore the signal.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def runs_written(folder: Path, *suffixes: str) -> tuple[list[object], list[Path]]:
    """Options that write a run to files with these suffixes, and the files."""
    names = {"npz": "--out", "csv": "--csv", "html": "--html"}
    paths = [folder / f"run.{suffix}" for suffix in suffixes]
    return [x for path in paths for x in (names.get(path.suffix[1:], "--plot"), path)], paths


@pytest.fixture(scope="module")
def saved_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    run("simulate", "slider_crank", "--t-end", 2, "--out", path)
    return path


def test_info_of_a_saved_run_shows_the_residuals_of_the_singular_configurations_it_met(
    saved_run: Path, tmp_path: Path
) -> None:
    ideal = srm.load("slider_crank")
    pin = replace(ideal.loops[0], a=srm.Anchor("rod", xyz=(2.0 + 1e-6, 0.0, 0.0)))
    almost = srm.Mechanism(ideal.model, (pin,))
    state = srm.assemble(almost, {"crank": 0.3}, {"crank": 8.0}, guess={"rod": -0.6})
    srm.simulate(almost.with_state(state.q, state.v), 0.5).save(tmp_path / "almost.npz")

    assert row(run("info", saved_run), "singular passages") == "1"
    assert row(run("info", tmp_path / "almost.npz"), "singular passages").endswith(
        "; residuals up to 2.6e-07, 1 avoided"
    )


# -- help -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("simulate", "--t-end --method --tableau --rtol --atol --step --backend --out --plot"),
        ("simulate", "--csv --html --play MODEL psrm auto auto|python|kernel"),
        ("info", "MODEL degrees of freedom rank redundant"),
        ("models", "package"),
        ("play", "RUN browser"),
        ("plot", "RUN --out .png .pdf .svg"),
        ("csv", "RUN --out --every --point --reactions RUN.csv"),
    ],
)
def test_every_command_has_help_on_its_arguments_and_options(name: str, words: str) -> None:
    output = run(name, "--help")
    for word in words.split():
        assert word in output


def test_help_lists_the_commands_and_the_exit_status() -> None:
    output = run("--help")
    for word in ("simulate", "info", "models", "play", "plot", "benchmark", "--verbose"):
        assert word in output
    assert "2 for bad input" in output


def test_version_is_that_of_the_package() -> None:
    assert run("--version") == f"srm-mbs {srm.__version__}\n"


def test_the_saved_run_names_folders_only_if_asked(tmp_path: Path, describe: Describe) -> None:
    path, out = describe(), tmp_path / "run.npz"

    def text(*options: object) -> str:
        run("simulate", path, "--t-end", 0.1, "--out", out, *options)
        with np.load(out) as file:
            return str(file["meta"])

    assert str(tmp_path) not in text()
    assert str(path) in text("--full-paths")
    alone = run("simulate", path, "--t-end", 0.1, "--full-paths", status=2)
    assert "Give --out too" in alone


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from srm_mbs.cli.app import main\n"
        "sys.argv = ['srm-mbs', '--help']\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print(*sorted(sys.modules), sep='\\n')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert "srm_mbs.cli" in loaded
    assert not loaded & {"numpy", "scipy", "pinocchio", "matplotlib", "meshcat", "pydantic"}


# -- models and info --------------------------------------------------------------------------


def test_models_lists_every_bundled_mechanism_with_its_description() -> None:
    output = run("models")
    for name in srm.bundled_models():
        assert len(row(output, name)) > 20
    first = "Slider-crank with two equal bars of 2 m and 1 kg and a massless slider"
    assert row(output, "slider_crank").startswith(first)


def test_info_shows_degrees_of_freedom_rank_redundant_rows_joints_and_loops() -> None:
    output = run("info", "slider_crank_slider")
    assert row(output, "degrees of freedom") == "1"
    assert row(output, "closure rows") == "3"
    assert row(output, "rank") == "2"
    assert row(output, "redundant rows, left out") == "pin.y"
    assert row(output, "redundant rows, left to pivoting") == "0"
    assert re.split("  +", row(output, "crank")) == ["revolute", "5.49779 rad", "0 rad/s"]
    assert re.split("  +", row(output, "slider")) == ["prismatic along x", "2.82843 m", "0 m/s"]
    kind, a, b, gap = re.split("  +", row(output, "pin"))
    assert (kind, a, b) == ("point", "rod xyz [2, 0, 0] m", "slider")
    assert float(gap.removesuffix(" m")) < 1e-12


def test_info_shows_size_and_mass() -> None:
    """Two bars of 2 m at right angles, 45 degrees to the slider's line: a box of 2 sqrt 2 by
    sqrt 2."""
    output = run("info", "slider_crank_slider")
    assert row(output, "size") == f"{np.sqrt(10.0):.6g} m"
    assert row(output, "mass") == "2.5 kg"  # two bars of 1 kg and a slider of 0.5 kg
    urdf = (ROOT / "urdf" / "four_bar.urdf").read_text(encoding="utf-8")
    masses = [float(mass) for mass in re.findall(r'mass value="([^"]+)"', urdf)]
    assert row(run("info", "four_bar"), "mass") == f"{sum(masses):.6g} kg"


def test_a_mechanism_at_one_point_has_no_size(tmp_path: Path) -> None:
    """It shows 0 m and not the 1 m that its motion is measured in; the root link does not move."""
    path = tmp_path / "wheel.urdf"
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    path.write_text(
        '<robot name="wheel"><link name="base"><inertial><mass value="9"/>'
        f'{inertia}</inertial></link><link name="rim"><inertial><mass value="2.5"/>{inertia}'
        '</inertial></link><joint name="axle" type="continuous"><parent link="base"/>'
        '<child link="rim"/><axis xyz="0 0 1"/></joint></robot>'
    )
    output = run("info", path)
    assert row(output, "size") == "0 m"
    assert row(output, "mass") == "2.5 kg"


def test_info_tells_what_was_read_and_what_was_ignored(tmp_path: Path) -> None:
    assert row(run("info", "four_bar"), "read from").endswith("four_bar.toml (URDF)")
    assert row(run("info", "n_four_bar_3"), "read from") == "n_four_bar_3, generated (URDF)"
    path = tmp_path / "robot.yaml"
    path.write_text("closed_loop: []\ntype: []\nname_mot: [hip]\n")
    urdf = tree().replace("</robot>", "<transmission/></robot>")
    (tmp_path / "robot.urdf").write_text(urdf)
    output = run("info", path)
    assert row(output, "read from") == f"{path} (Gepetto YAML)"
    assert "note: joints with motors (name_mot), which exert nothing here: hip" in output
    assert "note: 1 <transmission> element(s) do not act and are ignored" in output


def test_info_lists_what_is_stiff_with_coefficients_and_times() -> None:
    output = run("info", "flyball_governor")
    found = row(output, "force left_spring")
    coefficient, seconds = re.split("  +", found)
    assert coefficient == "damping 40000 N s/m"
    assert seconds == "0.00021 s"
    assert "time constant" not in run("info", "four_bar")


def flagged_arm(folder: Path) -> Path:
    """Two arms that turn together, the first with a flag that has no inertia on its axis."""
    hinge = '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{0}"/>{2}</joint>'
    arms = "".join(
        f'<link name="{name}"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name in ("arm", "other")
    )
    joints = (
        hinge.format("arm", "base", ""),
        hinge.format("other", "base", '<mimic joint="arm"/>'),
        hinge.format("flag", "arm", ""),
    )
    path = folder / "arm.urdf"
    path.write_text(
        f'<robot name="r"><link name="base"/>{arms}<link name="flag"/>{"".join(joints)}</robot>'
    )
    return path


def test_massless_ends_are_treated_as_an_option_says(tmp_path: Path) -> None:
    path = flagged_arm(tmp_path)
    assert "--massless" in run("info", path, status=2)
    assert "are locked (massless" in run("info", path, "--massless", "fix")
    assert "have 0.1 kg" in run("info", path, "--massless", "0.1,1e-4")
    assert "--massless: '1' is neither fix nor two numbers" in run(
        "info", path, "--massless", "1", status=2
    )
    out = tmp_path / "out.toml"
    run("convert", path, out, "--massless", "fix", "--closing-tolerance", "1e-8")
    assert tomllib.loads(out.read_text())["closing_tolerance"] == 1e-8
    assert "are locked (massless" in run("simulate", out, "--t-end", "0.01") + run("info", out)


@pytest.mark.parametrize(
    "command",
    [
        ("simulate", "--t-end", "0.01"),
        ("info",),
        ("modes", "--hold", "arm", "--starts", "2"),
        ("equilibrium",),
        ("linearise",),
        ("drag", "arm=0.1"),
        ("convert", "out.toml", "--force"),
    ],
    ids=lambda command: command[0],
)
def test_every_command_that_reads_a_model_file_takes_the_same_options(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name, *others = command
    path = flagged_arm(tmp_path)
    given = ("--massless", "fix", "--closing-tolerance", "1e-9", "--allow-outside")
    assert "--massless" in run(name, path, *others, status=2)
    run(name, path, *others, *given)
    keyed = tmp_path / "keyed.xml"
    keyed.write_text(
        '<mujoco><worldbody><body name="b"><joint name="arm"/><geom size="0.1" pos="1 0 0"/></body>'
        '<body name="c"><joint name="other"/><geom size="0.1" pos="1 0 0"/></body></worldbody>'
        '<equality><joint joint1="other" joint2="arm"/></equality>'
        '<keyframe><key name="home" qpos="0.7 0.7"/></keyframe></mujoco>'
    )
    assert "there is no keyframe 'away'" in run(
        name, keyed, *others, "--keyframe", "away", status=2
    )
    run(name, keyed, *others, "--keyframe", "home")
    if name == "convert":
        assert tomllib.loads(Path("out.toml").read_text())["initial"]["guess"]["arm"] == 0.7


def test_info_of_an_open_chain_has_no_table_of_loops() -> None:
    output = run("info", "pendulum_chain")
    assert row(output, "degrees of freedom") == "3"
    assert "anchor" not in output


def test_info_shows_all_coordinates_of_joints_with_several(tmp_path: Path) -> None:
    path = tmp_path / "free.urdf"
    path.write_text(BOX)
    description = tmp_path / "free.toml"
    description.write_text('format = 1\nurdf = "free.urdf"\nbase = "floating"\n')
    kind, q, v = re.split("  +", row(run("info", description), "root_joint"))
    assert (kind, q, v) == ("floating", "[0, 0, 0, 0, 0, 0, 1]", "[0, 0, 0, 0, 0, 0]")


def test_info_repeats_what_was_noted_on_reading(describe: Describe, tmp_path: Path) -> None:
    source = ROOT / "urdf" / "four_bar.urdf"
    urdf = tmp_path / "own.urdf"
    urdf.write_text(source.read_text().replace("</robot>", "<transmission/></robot>"))
    output = run("info", describe((source.as_posix(), "own.urdf")))
    assert "note: 1 <transmission> element(s) do not act and are ignored" in output


def test_brackets_in_names_are_printed_as_they_are(describe: Describe) -> None:
    path = describe(('name = "four_bar"', 'name = "four[bold]bar[/]"'))
    assert row(run("info", path), "mechanism") == "four[bold]bar[/]"


# -- simulate ---------------------------------------------------------------------------------


def test_simulate_prints_a_summary_and_writes_every_file(tmp_path: Path) -> None:
    files, paths = runs_written(tmp_path, "npz", "png", "csv", "html")
    output = run("simulate", "slider_crank", "--t-end", 5, *files)
    solution = srm.load_solution(paths[0])
    assert row(output, "status") == "finished"
    assert row(output, "end time") == "5 s"
    assert row(output, "steps") == f"{solution.stats.steps}"
    assert row(output, "evaluations") == f"{solution.stats.evaluations}"
    assert row(output, "singular passages") == "2"
    assert row(output, "largest ||g||") == f"{solution.drift[:, 0].max():.2e} (m, rad)"
    for name in ("rejected steps", "placements", "zone steps", "energy change", "wall time"):
        assert row(output, name)
    for path in paths:
        assert f"written            {path}" in output
        assert path.stat().st_size > 5000
    assert "The run reached t = 5 s." in output


@pytest.mark.parametrize(
    ("options", "end", "tableau", "rtol", "atol"),
    [
        ("", "0.25 s", "auto", 1e-7, 1e-9),
        ("--t-end 0.5 --rtol 1e-5 --atol 1e-6 --tableau dopr54", "0.5 s", "dopr54", 1e-5, 1e-6),
    ],
)
def test_options_override_the_defaults_of_the_description(
    describe: Describe, options: str, end: str, tableau: str, rtol: float, atol: float
) -> None:
    path = describe(("t_end = 10.0", "t_end = 0.25\nrtol = 1e-7\natol = 1e-9"))
    out = path.with_name("run.npz")
    output = run("simulate", path, *options.split(), "--out", out)
    assert row(output, "end time") == end
    settings = srm.load_solution(out).settings
    assert (settings.tableau, settings.rtol, set(settings.atol)) == (tableau, rtol, {atol})


def test_simulate_uses_the_tableau_of_the_method_where_none_is_given(tmp_path: Path) -> None:
    out = tmp_path / "run.npz"
    for method, own in (("psrm", srm.PSRM()), ("srm", srm.SRM())):
        run("simulate", "four_bar", "--t-end", 0.01, "--method", method, "--out", out)
        assert srm.load_solution(out).settings.tableau == own.tableau


def test_simulate_with_a_fixed_step_takes_that_many() -> None:
    output = run("simulate", "four_bar", "--t-end", 0.5, "--step", 0.05)
    assert row(output, "steps") == "10"


def test_simulate_starts_where_it_is_told_under_the_given_gravity(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    start = ("--q", "crank=1.2", "--v", "crank=3", "--gravity", "0,0,-1.62")
    run("simulate", "four_bar", "--t-end", 0.2, "--out", path, *start)
    mechanism = srm.load("four_bar", gravity=(0.0, 0.0, -1.62))
    begun = srm.assemble(mechanism, {"crank": 1.2}, {"crank": 3.0})
    expected = srm.simulate(mechanism, 0.2, q0=begun.q, v0=begun.v)
    solution = srm.load_solution(path)
    np.testing.assert_array_equal(solution.q, expected.q)
    np.testing.assert_array_equal(solution.v, expected.v)
    assert solution.joint("crank")[1][0] == pytest.approx(3.0, rel=1e-14)


def test_simulate_with_a_floating_base_falls(tmp_path: Path) -> None:
    model, path = tmp_path / "stone.urdf", tmp_path / "run.npz"
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    model.write_text(
        f'<robot name="stone"><link name="stone"><inertial><mass value="2"/>{inertia}'
        "</inertial></link></robot>"
    )
    options = ("--base", "floating", "--gravity", "0,0,-1.62", "--t-end", 2, "--out", path)
    run("simulate", model, *options)
    fallen = srm.load_solution(path).q[-1, :3]
    np.testing.assert_allclose(fallen, [0.0, 0.0, -0.5 * 1.62 * 2.0**2], rtol=1e-9, atol=1e-12)


def test_open_chain_has_no_constraint_rows_in_its_summary() -> None:
    output = run("simulate", "pendulum_chain", "--t-end", 0.5)
    assert row(output, "status") == "finished"
    assert "||g||" not in output


def test_run_that_fails_keeps_what_it_has_and_exits_with_1(tmp_path: Path) -> None:
    files, paths = runs_written(tmp_path, "npz", "svg", "html")
    output = run("simulate", "pendulum_chain", "--step", 1, *files, status=1)
    assert row(output, "status") == "failed"
    assert "Stopped at t = " in output
    assert all(path.stat().st_size > 5000 for path in paths)
    solution = srm.load_solution(paths[0])
    assert not solution.success
    assert solution.stats.steps > 0


def test_run_that_fails_at_the_start_exits_with_1(tmp_path: Path) -> None:
    files, paths = runs_written(tmp_path, "npz", "png", "html")
    output = run("simulate", "pendulum_chain", "--step", 100, "--t-end", 1000, *files, status=1)
    assert row(output, "steps") == "0"
    assert all(path.exists() for path in paths)


def test_warnings_are_single_lines() -> None:
    output = run("simulate", "four_bar", "--t-end", 0.1, "--rtol", 0.1)
    (line,) = [line for line in output.splitlines() if "rtol" in line]
    assert line.startswith("warning: rtol = 0.1 is looser than 0.01")


def test_simulate_can_play_the_run_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    played = []
    monkeypatch.setattr("srm_mbs.api.Solution.play", lambda *given, **o: played.append((given, o)))
    run("simulate", "four_bar", "--t-end", 0.1, "--play", "--gaps", "--trace", "crank:1,0,0")
    (((solution,), options),) = played
    assert solution.t[-1] == 0.1
    anchor = srm.Anchor("crank", xyz=(1.0, 0.0, 0.0))
    assert options == {"trace": [anchor], "gaps": True, "reactions": False, "arrows": False}


@POSIX
@pytest.mark.parametrize("module", ["typer", "numpy"])
def test_ctrl_c_while_the_command_line_is_loaded_ends_it_without_a_word(
    tmp_path: Path, module: str
) -> None:
    # In place of a module that is imported: the signal comes while it is loaded.
    (tmp_path / f"{module}.py").write_text(
        "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(20)\n"
    )
    with subprocess.Popen(
        command("info", "four_bar"),
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        output, messages = process.communicate(timeout=60)
    if module == "typer":  # before any command has begun
        assert process.returncode == -signal.SIGINT
        assert messages == ""
    else:
        assert process.returncode == 130
        assert messages == "error: interrupted\n"
    assert output == ""


@POSIX
def test_a_command_whose_shell_ignores_ctrl_c_ignores_it() -> None:
    done = subprocess.run(
        [
            *(sys.executable, "-c"),
            "import signal, sys\n"
            "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
            "sys.argv = ['srm-mbs', '--version']\n"
            "from srm_mbs.__main__ import main\n"
            "try:\n    main()\nexcept SystemExit:\n    pass\n"
            "assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@POSIX
def test_interrupted_run_is_written_and_exits_with_1(tmp_path: Path) -> None:
    psutil = pytest.importorskip("psutil")
    out, plot = tmp_path / "run.npz", tmp_path / "run.png"
    # One of many bodies and no singular passages: few steps in this time, and little to write.
    args = ("simulate", "jansen_walker", "--t-end", 1e6, "--out", out, "--plot", plot)
    with started("-v", *args) as process:
        next(line for line in process.stderr if "from t = 0 to 1e+06 s" in line)  # about to begin
        # The first step is made within some ms of its CPU time, however busy the machine is.
        work = psutil.Process(process.pid)
        begun = work.cpu_times().user
        while process.poll() is None and work.cpu_times().user < begun + 0.3:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        output, messages = process.communicate(timeout=120)
    assert process.returncode == 1, messages
    assert row(output, "status") == "interrupted"
    assert "Interrupted at t = " in messages
    assert "Traceback" not in messages
    assert srm.load_solution(out).t[-1] > 0.0
    assert plot.stat().st_size > 5000


def test_passages_of_an_interrupted_run_are_left_to_whoever_reads_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(t: float, h: float, state: Any) -> None:
        if t > 4.0:
            raise KeyboardInterrupt

    def interrupted(*args: Any, **options: Any) -> srm.Solution:
        return simulate(*args, **options | {"progress": interrupt})

    simulate, out = srm.simulate, tmp_path / "run.npz"
    monkeypatch.setattr(srm, "simulate", interrupted)
    with monkeypatch.context() as patch:
        patch.setattr(
            "srm_mbs.integration.singular_passages.find_crossings",
            lambda *_: pytest.fail("looked for"),
        )
        output = run("-v", "simulate", "slider_crank", "--out", out, status=1)
    assert row(output, "status") == "interrupted"
    assert row(output, "written") == str(out)
    assert "singular passages" not in output
    assert len(srm.load_solution(out).crossings) == 2


# -- plot and play ----------------------------------------------------------------------------


def test_plot_writes_beside_the_run_unless_told_otherwise(saved_run: Path, tmp_path: Path) -> None:
    beside, other = saved_run.with_suffix(".png"), tmp_path / "drift.pdf"
    assert run("plot", saved_run) == f"written: {beside}\n"
    assert run("plot", saved_run, "--out", other) == f"written: {other}\n"
    assert beside.stat().st_size > 5000
    assert other.stat().st_size > 5000


def test_the_commands_of_the_page_of_plots_write_their_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (DOCS / "plots.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    lines = [line for kind, text in blocks(page) if kind == "sh" for line in text.splitlines()]
    assert len(lines) > 3
    for line in lines:
        program, *words = shlex.split(line)
        assert program == "srm-mbs"
        run(*words)
    for name in ("run_state.png", "path.pdf", "poses.pdf", "hinge.pdf"):
        assert (tmp_path / name).stat().st_size > 5000


def test_a_table_of_equal_times_has_the_states_of_dense_output(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    run("simulate", "four_bar", "--t-end", 0.35, "--csv", path, "--every", 0.1)
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    table = np.array([[float(cell) for cell in line.split(",")] for line in rows])
    np.testing.assert_allclose(table[:, 0], [0.0, 0.1, 0.2, 0.3], rtol=1e-15)
    q, v = srm.simulate(srm.load("four_bar"), 0.35, rtol=1e-6)(table[:, 0])
    np.testing.assert_allclose(table[:, 1:4], q, atol=1e-9)
    np.testing.assert_allclose(table[:, 4:7], v, atol=1e-9)
    assert head.startswith("t (s),crank (rad),")
    # 3 times 0.1 is above 0.3: the last row is the end of the run.
    run("simulate", "four_bar", "--t-end", 0.3, "--csv", path, "--every", 0.1)
    assert path.read_text(encoding="utf-8").splitlines()[-1].startswith("0.3,")


def test_a_printed_table_is_all_of_standard_output(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    options = ("--t-end", 0.3, "--backend", "python", "--every", 0.1)
    run("simulate", "four_bar", *options, "--csv", path)
    done = run_apart("simulate", "four_bar", *options, "--csv", "-", "--balance")
    assert done.returncode == 0
    assert done.stdout == path.read_text(encoding="utf-8")
    assert "energy gained" in done.stderr
    assert "The run reached t = 0.3 s." in done.stderr
    assert not Path("-").exists()


@pytest.mark.parametrize("every", [0, -1, "nan", 1e-12])
def test_an_interval_that_gives_no_table_is_refused_before_the_run(every: object) -> None:
    options = ("--t-end", 1, "--csv", "-", "--every", every)
    assert "--every: an interval of" in run("simulate", "four_bar", *options, status=2)


def test_csv_writes_the_table_of_a_saved_run(saved_run: Path, tmp_path: Path) -> None:
    path, point = tmp_path / "table.csv", ("--point", "rod:2,0,0")
    simulate = ("simulate", "slider_crank", "--t-end", 2, "--csv", path, *point)
    for every in ((), ("--every", 0.3)):
        run(*simulate, *every)
        table = path.read_text(encoding="utf-8")
        assert run("csv", saved_run, "--out", "-", *point, *every) == table
    shutil.copy(saved_run, tmp_path / "own.npz")
    assert run("csv", tmp_path / "own.npz") == f"written: {tmp_path / 'own.csv'}\n"
    head = (tmp_path / "own.csv").read_text(encoding="utf-8").splitlines()[0]
    assert head.startswith("t (s),crank (rad),")


def test_csv_begins_where_the_run_begins_and_has_reactions_on_request(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    solution = srm.simulate(srm.load("four_bar"), -1.0, t0=-1.5)
    solution.save(path)
    lines = run("csv", path, "--out", "-", "--every", 0.2, "--reactions").splitlines()
    head, *rows = csv.reader(lines)
    times = [-1.5, -1.3, -1.1]
    np.testing.assert_allclose([float(row[0]) for row in rows], times, rtol=1e-15)
    found = [float(row[head.index("closure pin fx (N)")]) for row in rows]
    np.testing.assert_allclose(found, solution.at(times).reactions["pin"][:, 0], rtol=1e-9)


def test_csv_names_file_element_and_remedy_of_what_it_refuses(
    saved_run: Path, tmp_path: Path
) -> None:
    for words, *parts in (
        (("--every", 0), "--every", "an interval of 0 s", "Give at least 2e-07 s"),
        (("--point", "wheel:0,0,0"), "--point", "wheel", "Known: "),
        (("--out", tmp_path / "run.xls"), "run.xls: --out: the suffix '.xls'", "Use .csv"),
        (("--out", tmp_path / "none" / "run.csv"), "there is no folder", "Make it first"),
    ):
        line = error_line(run("csv", saved_run, *words, status=2))
        assert all(part in line for part in parts), line
    controlled, empty = tmp_path / "controlled.npz", tmp_path / "empty.npz"
    srm.simulate(srm.load("four_bar"), 0.1, controller=lambda t, q, v: np.zeros(3)).save(controlled)
    line = error_line(run("csv", controlled, "--reactions", status=2))
    assert line.startswith(f"error: {controlled}: --reactions: the "), line
    assert line.endswith("simulate again"), line
    table = run("csv", controlled, "--point", "rocker:1,0,0", "--out", "-")
    assert "warning: the table has no accelerations of points: " in table
    assert "rocker (1; 0; 0) vz (m/s)" in table
    empty.touch()
    assert f"error: {empty}: " in run("csv", empty, status=2)


def test_play_writes_the_page_of_a_saved_run(saved_run: Path, tmp_path: Path) -> None:
    trace = ("--trace", "rod:2,0,0")
    output = run("play", saved_run, "--html", tmp_path / "played.html", *trace)
    assert output == f"written: {tmp_path / 'played.html'}\n"
    simulate = ("simulate", "slider_crank", "--t-end", 2, "--html", tmp_path / "simulated.html")
    run(*simulate, *trace)
    played, simulated = (
        (tmp_path / f"{name}.html").read_bytes() for name in ("played", "simulated")
    )
    assert len(played) == pytest.approx(len(simulated), rel=0.01)
    missing = tmp_path / "missing" / "page.html"
    assert "there is no folder" in run("play", saved_run, "--html", missing, status=2)
    assert "--html: the suffix '.txt'" in run("play", saved_run, "--html", "page.txt", status=2)


@POSIX
def test_play_serves_a_saved_run_until_it_is_interrupted(saved_run: Path) -> None:
    with started("play", saved_run) as process:
        next(line for line in process.stderr if "slider_crank is played at http://" in line)
        process.send_signal(signal.SIGINT)
        messages = process.communicate(timeout=120)[1]
    assert process.returncode == 0, messages
    assert "Traceback" not in messages


# -- as a shell sees it -----------------------------------------------------------------------


def test_results_go_to_standard_output_and_nothing_else_does() -> None:
    done = run_apart("simulate", "slider_crank", "--t-end", 1)
    assert (done.returncode, done.stderr) == (0, "")
    assert row(done.stdout, "status") == "finished"
    assert "\x1b" not in done.stdout


def test_piped_errors_are_not_wrapped_to_the_width_of_a_terminal(describe: Describe) -> None:
    path = describe(("[initial.guess]", "[initial.gues]"))
    done = run_apart("info", path, COLUMNS="40")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: {path}: initial.gues: unknown key 'gues'. Known: ")


def test_piped_tables_are_not_wrapped_to_the_width_of_a_terminal() -> None:
    done = run_apart("models", COLUMNS="40")
    assert len(done.stdout.splitlines()) == len(srm.bundled_models()) + 1


def test_verbose_logs_to_standard_error() -> None:
    done = run_apart("-v", "info", "four_bar")
    assert done.returncode == 0
    assert done.stdout == run("info", "four_bar")  # both streams: quiet without it
    assert "info: four_bar: 1 degrees of freedom, rank 2\n" in done.stderr


@POSIX
def test_reader_that_closes_the_pipe_early_causes_no_complaint() -> None:
    with subprocess.Popen(
        command("models"), cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        process.stdout.close()
        assert process.stderr.read() == ""


@pytest.mark.parametrize(("given", "used"), [(None, "1"), ("3", "3")])
def test_the_command_line_keeps_blas_to_one_thread_unless_told_otherwise(
    given: str | None, used: str
) -> None:
    code = (
        "import sys, srm_mbs.cli.app, os\n"
        "assert 'numpy' not in sys.modules, 'too late'\n"
        "print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    plain = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
    environment = plain if given is None else plain | {"OPENBLAS_NUM_THREADS": given}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == used


def test_rounding_of_the_assembly_is_shown_as_zero() -> None:
    mechanism = srm.load("four_bar")
    q = np.array([1.0, -3e-29, 2e-13])
    noisy = srm.Mechanism(mechanism.model, q0=q, v0=np.array([1e-14, 0.5, -1e-20]))
    shown = [row[2:] for row in joint_rows(noisy)]
    assert shown == [("1 rad", "0 rad/s"), ("0 rad", "0.5 rad/s"), ("0 rad", "0 rad/s")]


@pytest.mark.parametrize("imitated", [False, True])
def test_the_benchmark_of_another_folder_is_not_run_whatever_it_imitates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, imitated: bool
) -> None:
    folder = tmp_path / "benchmarks" / "work_precision"
    if imitated:  # all of a checkout, with another benchmark
        for name in ("srm_mbs", "benchmarks"):
            shutil.copytree(ROOT / name, tmp_path / name)
        for name in ("pyproject.toml", "CMakeLists.txt", "README.md"):
            shutil.copy(ROOT / name, tmp_path)
    else:
        folder.mkdir(parents=True)
    (folder / "__main__.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    assert "Run it at the top of a checkout of the source" in run("benchmark", status=2)
    assert not (tmp_path / "ran").exists()
