# SPDX-License-Identifier: Apache-2.0
# For colcon; pip reads the pyproject.toml above.
from setuptools import find_packages, setup

NAME = "openarm_perception"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME, *(f"{NAME}.{part}" for part in find_packages("."))],
    package_dir={NAME: "."},
    package_data={NAME: ["py.typed", "frames/*.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    entry_points={
        "console_scripts": [
            "cloud_node = openarm_perception.ros.cloud_node:main",
            "detect_node = openarm_perception.ros.detector_node:main",
            "stereo_node = openarm_perception.ros.stereo_node:main",
        ]
    },
)
