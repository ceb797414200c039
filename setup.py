# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
"""The ament_python package g2_recon: what colcon builds and pip installs."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "g2_recon"
ROOT = Path(__file__).resolve().parent
MANIFEST = ElementTree.parse(ROOT / "package.xml")

# The processors, systems and Python versions for which the index holds ROS 2 Jazzy.
ROS_WHEELS = "sys_platform == 'linux' and platform_machine == 'x86_64' and python_version < '3.15'"


def manifest(tag: str) -> str:
    """The text of an element of package.xml, so that the version and the like are written down once."""
    text = MANIFEST.findtext(tag)
    if not text:
        raise ValueError(f"package.xml has no <{tag}>")
    return text.strip()


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """All files of a folder, each to its place under share/g2_recon, as `data_files` wants them."""
    files = sorted(
        path.relative_to(ROOT)
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith(".")
    )
    return [(f"share/{PACKAGE}/{file.parent.as_posix()}", [file.as_posix()]) for file in files]


setup(
    name=PACKAGE,
    version=manifest("version"),
    description=manifest("description"),
    license=manifest("license"),
    author=manifest("author"),
    maintainer=manifest("maintainer"),
    python_requires=">=3.10",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed"], f"{PACKAGE}.nodes": ["fast_dds.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *shared("launch"),
        *shared("config"),
        *shared("rviz"),
        *shared("bags"),
    ],
    zip_safe=False,
    # docs/dependencies.md says what each is for.
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.15.3",
        "numba>=0.59",
        "pydantic>=2.6",
        "PyYAML>=6.0",
        "rosbags>=0.11,<0.12",
        "trimesh>=4.6",
        "matplotlib>=3.6",
        "rich>=13.7",
        "small_gicp>=1.0.1",
        "kiss-icp>=1.3.0",
    ],
    extras_require={
        "ros": [
            f"ros-jazzy-rclpy==7.1.6; {ROS_WHEELS}",
            f"ros-rclpy[fastrtps]==7.1.*; {ROS_WHEELS}",
            f"ros-jazzy-common-interfaces==5.3.6; {ROS_WHEELS}",
        ],
        # ruff and mypy find more with each release: a newer one is a change of its own.
        "dev": [
            "colcon-common-extensions>=0.3",
            "colcon-ros>=0.5",
            "hypothesis>=6.100",
            "mypy==2.4.*",
            "pytest>=8.0",
            "ruff==0.17.*",
        ],
    },
    entry_points={
        "console_scripts": [
            f"g2-recon = {PACKAGE}.cli:main",
            *(
                f"{node} = {PACKAGE}.nodes.{node}:main"
                for node in (
                    "localizer_node",
                    "registrar_node",
                    "sweep_node",
                    "reconstruct_node",
                    "map_merger_node",
                    "replay_node",
                    "pipeline_node",
                )
            ),
        ],
    },
)
