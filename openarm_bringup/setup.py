# SPDX-License-Identifier: Apache-2.0
# For colcon; pip reads the pyproject.toml above.
from setuptools import find_packages, setup

NAME = "openarm_bringup"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME, *(f"{NAME}.{part}" for part in find_packages("."))],
    package_dir={NAME: "."},
    package_data={NAME: ["py.typed", "view/page/*", "view/page/vendor/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/openarm.launch.py"]),
    ],
    install_requires=["setuptools"],
    entry_points={
        "console_scripts": [
            "openarm = openarm_bringup.cli:main",
            "flight_recorder = openarm_bringup.bags.ros.flight_recorder:main",
        ]
    },
)
