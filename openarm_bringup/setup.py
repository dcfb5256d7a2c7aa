# SPDX-License-Identifier: Apache-2.0
# For colcon; pip reads the pyproject.toml above.
from setuptools import setup

NAME = "openarm_bringup"
PARTS = (
    "bags",
    "calibration",
    "campaign",
    "commands",
    "demo",
    "detector",
    "doctor",
    "judging",
    "supervision",
    "view",
)

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME, *(f"{NAME}.{part}" for part in PARTS)],
    package_dir={NAME: "."},
    package_data={NAME: ["py.typed", "view/page/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/openarm.launch.py"]),
    ],
    install_requires=["setuptools"],
    entry_points={"console_scripts": ["openarm = openarm_bringup.cli:main"]},
)
