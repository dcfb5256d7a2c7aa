# SPDX-License-Identifier: Apache-2.0
# For colcon; pip reads the pyproject.toml above. This package brings the suite's models and parameters.
from pathlib import Path

from setuptools import find_packages, setup

NAME = "openarm_common"
SHARED = [path for folder in ("models", "config") for path in Path("..", folder).rglob("*") if path.is_file()]

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME, *(f"{NAME}.{part}" for part in find_packages("."))],
    package_dir={NAME: "."},
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((str(Path("share", "openarm", *path.parts[1:-1])), [str(path)]) for path in SHARED),
    ],
    install_requires=["setuptools"],
)
