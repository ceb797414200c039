# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The package as colcon, ROS 2 and pip see it."""

from __future__ import annotations

import ast
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any, NoReturn

import pytest

import g2_recon

ROOT = Path(__file__).resolve().parents[1]
NODES = (
    "localizer_node",
    "registrar_node",
    "sweep_node",
    "reconstruct_node",
    "map_merger_node",
    "replay_node",
    "pipeline_node",
)
SHARED_FOLDERS = ("bags", "config", "launch", "rviz")
MADE_HERE = (".*", "build", "install", "log", "out", "__pycache__", "*.egg-info")

# The rosdep key of each distribution that pip installs. Keys end in -pip where Ubuntu 24.04 has no package of it.
ROSDEP_KEYS = {
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pydantic": "python3-pydantic",
    "PyYAML": "python3-yaml",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "trimesh": "python3-trimesh-pip",
}
# rosdep has no key for these, so that pip alone brings them.
WITHOUT_KEY = {"kiss-icp", "small_gicp"}
# What is imported under another name than that of its distribution or of its ROS 2 package.
DISTRIBUTIONS = {"kiss_icp": "kiss-icp", "mpl_toolkits": "matplotlib", "yaml": "PyYAML"}
ROS_PACKAGES = {"tf2_ros": "tf2_ros_py"}


def skip_or_fail(reason: str) -> NoReturn:
    """Skip, but fail where continuous integration has to have what is missing."""
    if os.environ.get("CI") == "true" and platform.machine() == "x86_64":
        pytest.fail(reason)
    pytest.skip(reason)


def needed(module: str) -> Any:
    try:
        return __import__(module, fromlist=[""])
    except ImportError as error:
        skip_or_fail(f"{module} is not installed: {error}")


@pytest.fixture(scope="module")
def colcon() -> str:
    places = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    return shutil.which("colcon", path=places) or skip_or_fail("colcon is not installed")


@pytest.fixture(scope="module")
def manifest() -> Any:
    return needed("catkin_pkg.package").parse_package(ROOT / "package.xml")


@pytest.fixture(scope="module")
def prefix(colcon: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where colcon installed a copy of the source tree."""
    workspace = tmp_path_factory.mktemp("workspace")
    shutil.copytree(ROOT, workspace / "src/g2_recon", ignore=shutil.ignore_patterns(*MADE_HERE, "test"))
    build = subprocess.run(
        [colcon, "build"],
        cwd=workspace,
        env={**os.environ, "COLCON_HOME": str(workspace / "home")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert build.returncode == 0, build.stdout
    return workspace / "install/g2_recon"


@pytest.fixture(scope="module")
def sourced(prefix: Path) -> dict[str, str]:
    """The environment after `source install/setup.bash`."""
    script = f". '{prefix.parent}/setup.bash' && env -0"
    output = subprocess.run(["bash", "-c", script], stdout=subprocess.PIPE, text=True, check=True).stdout
    return dict(variable.split("=", 1) for variable in output.split("\0") if variable)


@pytest.fixture(scope="module")
def installed(prefix: Path) -> Distribution:
    (found,) = distributions(name="g2_recon", path=[str(path) for path in prefix.glob("lib/python3*/site-packages")])
    return found


def python_files() -> Iterator[Path]:
    folders = [ROOT / name for name in ("g2_recon", "launch", "test", "benchmarks")]
    return (path for top in (ROOT / "setup.py", *folders) for path in ([top] if top.is_file() else top.rglob("*.py")))


def imported(folder: Path, *, but_not: Path | None = None) -> dict[str, set[str]]:
    """Which modules of a folder import which packages, without the standard library and g2_recon."""
    own = {*sys.stdlib_module_names, "g2_recon"}
    found: dict[str, set[str]] = {}
    for path in folder.rglob("*.py"):
        if but_not and path.is_relative_to(but_not):
            continue
        for statement in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in statement.names] if isinstance(statement, ast.Import) else []
            if isinstance(statement, ast.ImportFrom) and statement.module and not statement.level:
                names = [statement.module]
            for name in {name.split(".")[0] for name in names} - own:
                found.setdefault(DISTRIBUTIONS.get(name, name), set()).add(str(path.relative_to(ROOT)))
    return found


def lower_bounds(distribution: Distribution) -> dict[str, str]:
    requirement = needed("packaging.requirements").Requirement
    requirements = [requirement(text) for text in distribution.requires or []]
    return {
        item.name: next(bound.version for bound in item.specifier if bound.operator == ">=")
        for item in requirements
        if not (item.marker and "extra" in str(item.marker))
    }


def test_colcon_lists_an_ament_python_package(colcon: str) -> None:
    command = [colcon, "--log-base", os.devnull, "list", "--base-paths", str(ROOT)]
    listed = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    assert listed.split("\t") == ["g2_recon", str(ROOT), "(ros.ament_python)\n"]


def test_the_manifest_is_valid() -> None:
    package = needed("catkin_pkg.package")
    warnings: list[str] = []
    manifest = package.parse_package(ROOT / "package.xml", warnings=warnings)
    manifest.validate(warnings=warnings)
    assert warnings == []


def test_the_license_file_of_the_manifest_is_there(manifest: Any) -> None:
    assert [(str(item), (ROOT / item.file).is_file()) for item in manifest.licenses] == [("Apache-2.0", True)]


def test_python_and_the_manifest_have_the_same_version(manifest: Any) -> None:
    assert g2_recon.__version__ == manifest.version


def test_the_changelog_starts_with_this_version(manifest: Any) -> None:
    changelog = needed("catkin_pkg.changelog").get_changelog_from_path(str(ROOT), "g2_recon")
    newest = next(version for version, _, _ in changelog.foreach_version())
    assert newest == manifest.version


def test_the_installed_package_has_the_version_of_the_manifest(installed: Distribution, manifest: Any) -> None:
    assert installed.version == manifest.version


def test_every_python_file_says_its_license() -> None:
    header = [
        "# SPDX-FileCopyrightText: 2026 The g2_recon developers",
        "# SPDX-License-Identifier: Apache-2.0",
    ]
    assert [str(path) for path in python_files() if path.read_text(encoding="utf-8").splitlines()[:2] != header] == []


@pytest.mark.parametrize("node", NODES)
def test_ros2_run_finds_an_executable(prefix: Path, node: str) -> None:
    assert os.access(prefix / "lib/g2_recon" / node, os.X_OK)


def test_the_ament_index_knows_the_package(prefix: Path) -> None:
    assert (prefix / "share/ament_index/resource_index/packages/g2_recon").is_file()


def test_the_manifest_is_installed(prefix: Path) -> None:
    assert (prefix / "share/g2_recon/package.xml").read_bytes() == (ROOT / "package.xml").read_bytes()


@pytest.mark.parametrize("folder", SHARED_FOLDERS)
def test_ros2_launch_finds_what_is_shared(prefix: Path, folder: str) -> None:
    def files(top: Path) -> list[str]:
        paths = (path for path in top.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
        return sorted(str(path.relative_to(top)) for path in paths if not path.name.startswith("."))

    assert files(prefix / "share/g2_recon" / folder) == files(ROOT / folder) != []


def test_every_module_is_installed_and_so_is_what_else_it_needs(installed: Distribution) -> None:
    def files(top: Path) -> set[str]:
        return {str(path.relative_to(top)) for name in ("*.py", "*.xml", "py.typed") for path in top.rglob(name)}

    assert files(Path(str(installed.locate_file("g2_recon")))) == files(ROOT / "g2_recon")


def test_a_sourced_workspace_goes_before_the_source_tree(
    prefix: Path, sourced: Mapping[str, str], tmp_path: Path
) -> None:
    needed("rclpy")
    code = "import g2_recon.nodes.reconstruct_node as node; print(node.__file__)"
    command = [sys.executable, "-c", code]
    output = subprocess.run(command, env=sourced, cwd=tmp_path, stdout=subprocess.PIPE, text=True, check=True).stdout
    assert Path(output.strip()).is_relative_to(prefix)


def test_an_installed_node_comes_up_and_ends_when_told_to(
    prefix: Path, sourced: Mapping[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rclpy = needed("rclpy")
    # No other robot, nor another test run, may answer.
    domain = os.getpid() % 100 + 1
    discovery = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        process = subprocess.Popen(
            [prefix / "lib/g2_recon/reconstruct_node", "--ros-args", "--remap", "__node:=from_install"],
            env={**sourced, **discovery, "ROS_LOG_DIR": str(tmp_path)},
            cwd=tmp_path,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    try:
        observer = rclpy.create_node("observer", context=context)
        deadline = time.monotonic() + 30
        while "from_install" not in observer.get_node_names():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, f"no such node after 30 s: {log.read_text()}"
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0, log.read_text()
    finally:
        process.kill()
        process.wait()
        rclpy.shutdown(context=context)


def test_every_requirement_of_pip_that_rosdep_knows_is_one_of_it_with_the_same_lower_bound(
    installed: Distribution, manifest: Any
) -> None:
    # rosdep cannot tell pip which version to take.
    wanted = {
        ROSDEP_KEYS[name]: None if ROSDEP_KEYS[name].endswith("-pip") else bound
        for name, bound in lower_bounds(installed).items()
        if name not in WITHOUT_KEY
    }
    keys = {item.name: item.version_gte for item in manifest.exec_depends if item.name.startswith("python3-")}
    assert keys == wanted


def test_the_core_imports_requirements_only_and_so_nothing_of_ros(installed: Distribution) -> None:
    imports = imported(ROOT / "g2_recon", but_not=ROOT / "g2_recon/nodes")
    assert {name: paths for name, paths in imports.items() if name not in lower_bounds(installed)} == {}


@pytest.mark.parametrize("folder", ["g2_recon/nodes", "launch"])
def test_what_nodes_and_launch_files_import_is_in_the_manifest(manifest: Any, folder: str) -> None:
    declared = {item.name for item in manifest.exec_depends}
    imports = {
        ROS_PACKAGES.get(name, ROSDEP_KEYS.get(name, name)): paths for name, paths in imported(ROOT / folder).items()
    }
    assert {name: paths for name, paths in imports.items() if name not in declared} == {}


def test_what_is_large_and_only_draws_is_not_imported_by_what_does_not_draw() -> None:
    # Matplotlib and scipy.stats take 25 MB of memory each.
    code = "import sys, g2_recon.cli, g2_recon.pipeline; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert "scipy.spatial" in loaded
    assert [name for name in ("matplotlib", "scipy.stats") if name in loaded] == []
