#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# tools/colcon_check.sh [FOLDER]: builds the committed tree with colcon as a native ROS 2 workspace does, then starts a node and
# a graph of what was installed. Takes five minutes; FOLDER (a new temporary one) keeps all of it.
# ROS itself comes from the wheels here, in an environment of its own; in a native Jazzy, source that and call colcon. The
# largest message packages that a native one has are those of .venv: nothing is built where a package is installed.
set -eu

root=$(cd "$(dirname -- "$0")/.." && pwd)
for tool in python uv; do
    [ -x "$root/.venv/bin/$tool" ] || {
        echo "colcon_check: no $root/.venv/bin/$tool; run ./openarm doctor once, which sets .venv up" >&2
        exit 2
    }
done
work=${1:-$(mktemp -d "${TMPDIR:-/tmp}/openarm-colcon-XXXXXX")}
mkdir -p "$work"
work=$(cd "$work" && pwd)
env=$work/env
say() { printf '== %s\n' "$*"; }

uv=$root/.venv/bin/uv
unset PYTHONPATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

say "environment in $env"
[ -x "$env/bin/python" ] || "$uv" venv --quiet --no-python-downloads --python "$root/.venv/bin/python" "$env"
for lock in requirements.lock requirements-build.lock; do
    "$uv" pip install --quiet --python "$env" --require-hashes -r "$root/$lock"
done
"$uv" pip install --quiet --python "$env" colcon-common-extensions
"$root/.venv/bin/python" "$root/tools/colcon_run.py" --give "$env"
# CMake takes what lies beside any bin of PATH for installed: with that of .venv, its tf2_msgs instead of the one built here.
PATH=$env/bin:/usr/local/bin:/usr/bin:/bin
export PATH

say "copy of the tree in $work/ws/src"
rm -rf "$work/ws"
mkdir -p "$work/ws/src/openarm"
git -C "$root" archive HEAD | tar -x -C "$work/ws/src/openarm"

say "colcon build"
cd "$work/ws"
AMENT_PREFIX_PATH=$env CMAKE_PREFIX_PATH=$env colcon build --executor sequential --event-handlers console_direct- \
    --cmake-args "-DPython3_EXECUTABLE=$env/bin/python" -DBUILD_TESTING=OFF -Wno-unused-cli

say "what was installed"
AMENT_PREFIX_PATH=$env
export AMENT_PREFIX_PATH
set +u
. install/setup.sh
set -u
ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-$(python -c 'import random; print(random.randrange(1, 102))')}
ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
MUJOCO_GL=${MUJOCO_GL:-egl}
OPENARM_RUNS=$work/runs
XDG_RUNTIME_DIR=$work/xdg
export ROS_DOMAIN_ID ROS_AUTOMATIC_DISCOVERY_RANGE MUJOCO_GL OPENARM_RUNS XDG_RUNTIME_DIR
mkdir -p "$XDG_RUNTIME_DIR"
exec python "$root/tools/colcon_run.py" "$work/ws/install"
