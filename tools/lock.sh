#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Writes the hashed locks from pyproject.toml, for all supported versions of CPython. Pins stay unless --upgrade is given.
set -eu
cd "$(dirname -- "$0")/.."

lock() {
    out=$1
    shift
    uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate --no-header -o "$out" "$@"
}

lock requirements.lock pyproject.toml --extra test --group setup "$@"
lock requirements-build.lock --group interfaces "$@"
lock requirements-dev.lock --group dev --constraints requirements.lock "$@"
printf '%s\n' pymoveit2 trimesh | lock requirements-moveit.lock --constraints requirements.lock "$@" -
echo foxglove-sdk | lock requirements-viz.lock --constraints requirements.lock "$@" -
printf 'pyrealsense2\nlibusb-package\n' | lock requirements-realsense.lock --constraints requirements.lock "$@" -
echo python-can | lock requirements-can.lock --constraints requirements.lock "$@" -
