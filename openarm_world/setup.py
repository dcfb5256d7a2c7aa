# SPDX-License-Identifier: Apache-2.0
# For colcon; pip reads the pyproject.toml above.
from setuptools import find_packages, setup

NAME = "openarm_world"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME, *(f"{NAME}.{part}" for part in find_packages("."))],
    package_dir={NAME: "."},
    package_data={NAME: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
)
