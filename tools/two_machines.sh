#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# tools/two_machines.sh [multicast|server] [FOLDER]: the graph split over two hosts, as root. `control` and `vision` run in
# network namespaces of their own, joined by a veth pair, each with its own /dev/shm, so that nothing but the network is between
# them. Asks for the same grasp on one host and over two, and tells what the network loses and how long it takes.
set -eu

mode=${1:-multicast}
out=${2:-$(mktemp -d "${TMPDIR:-/tmp}/openarm-two-XXXXXX")}
root=$(cd "$(dirname -- "$0")/.." && pwd)
openarm=$root/.venv/bin/openarm
[ -x "$openarm" ] || openarm=openarm
one=openarm_one_$$ two=openarm_two_$$
started= holders=

case $mode in multicast | server) ;; *) echo "two_machines: expected multicast or server, got $mode" >&2; exit 2 ;; esac
[ "$(id -u)" = 0 ] && command -v ip >/dev/null || { echo "two_machines: needs root and iproute2" >&2; exit 77; }

# What a socket is granted less than the profile asks for (config/fastdds_network.xml) costs images.
granted=$(cat /proc/sys/net/core/rmem_max)
[ "$granted" -ge 4194304 ] || echo "two_machines: net.core.rmem_max is $granted: images will be lost; see docs/two_machines.md" >&2

finish() {
    status=$?
    trap - EXIT INT TERM
    for pid in $started; do kill -INT "$pid" 2>/dev/null || :; done
    for pid in $started; do wait "$pid" || :; done
    for pid in $holders; do kill "$pid" 2>/dev/null || :; done
    ip netns del "$one" 2>/dev/null || :
    ip netns del "$two" 2>/dev/null || :
    exit "$status"
}
trap finish EXIT
trap 'exit 130' INT TERM

# host NAME: a network and a /dev/shm of its own, held by a process that sleeps.
host() {
    ip netns add "$1"
    ip netns exec "$1" ip link set lo up
    ip netns exec "$1" unshare --mount sh -c 'mount -t tmpfs -o size=256m tmpfs /dev/shm; exec sleep infinity' &
    eval "pid_$1=$!"
    holders="$holders $!"
    mkdir -p "$out/$1"
}

# on NAME COMMAND...: as if on that machine; the process becomes the command, so that signals reach it.
on() {
    name=$1
    shift
    eval "at=\$pid_$name"
    exec nsenter --target "$at" --mount --net \
        env XDG_RUNTIME_DIR="$out/$name" OPENARM_RUNS="$out/$name/runs" ROS_DOMAIN_ID=0 "$@"
}

# wait_for FILE TEXT PID
wait_for() {
    tries=0
    until grep -q "$2" "$1" 2>/dev/null; do
        tries=$((tries + 1))
        if [ "$tries" -gt 600 ] || ! kill -0 "$3" 2>/dev/null; then
            echo "two_machines: no '$2' in $1" >&2
            tail -n 20 "$1" >&2
            exit 1
        fi
        sleep 0.2
    done
}

# up HOST GRAPH: started, and ready.
up() {
    (on "$1" "$openarm" up "$2" --discovery subnet) >"$out/$2.log" 2>&1 &
    started="$started $!"
    wait_for "$out/$2.log" 'is ready' "$!"
}

cd "$out"
host "$one"
host "$two"
ip link add "va$$" netns "$one" type veth peer name "vb$$" netns "$two"
for end in "$one va$$ 10.77.0.1" "$two vb$$ 10.77.0.2"; do
    set -- $end
    ip netns exec "$1" ip address add "$3/24" dev "$2"
    ip netns exec "$1" ip link set "$2" up
    ip netns exec "$1" ip route add 224.0.0.0/4 dev "$2"
done

echo "== one host: sim"
up "$one" sim
(on "$one" "$openarm" pick red --json "$out/one.json") || :
for pid in $started; do kill -INT "$pid"; wait "$pid" || :; done
started=

echo "== two hosts ($mode): control on 10.77.0.1, vision on 10.77.0.2"
if [ "$mode" = server ]; then
    # Libraries of the wheels are known to their Python alone.
    libraries=$("$(dirname -- "$openarm")/python" -c 'import os; print(os.environ.get("LD_LIBRARY_PATH", ""))')
    (on "$one" env LD_LIBRARY_PATH="$libraries" "$(dirname -- "$openarm")/fast-discovery-server" -i 0 -l 10.77.0.1 -p 11811) >"$out/server.log" 2>&1 &
    started="$started $!"
    wait_for "$out/server.log" 'Server is running' "$!"
    ROS_DISCOVERY_SERVER=10.77.0.1:11811
    ROS_SUPER_CLIENT=TRUE
    export ROS_DISCOVERY_SERVER ROS_SUPER_CLIENT
fi
up "$one" control
up "$two" vision
for topic in /joint_states /overhead/depth/image_raw; do
    (on "$two" "$openarm" topic hz "$topic" --seconds 5 --json "$out/$(echo "$topic" | tr / _).json") || :
done
(on "$one" "$openarm" pick red --json "$out/two.json") || :

echo "== result in $out"
"$(dirname -- "$openarm")/python" - "$out" <<'PY'
import json
import sys
from pathlib import Path

out = Path(sys.argv[1])
one, two = (json.loads((out / f"{name}.json").read_text()) for name in ("one", "two"))
for name, answer in (("one host", one), ("two hosts", two)):
    print(f"{name}: {answer['code']}: {answer['message']} (place {answer.get('place_position')})")
for path in sorted(out.glob("_*.json")):
    link = json.loads(path.read_text())
    print(
        f"{link['topic']}: {link['rate_hz']:.1f} Hz, {link['lost']} of {link['messages'] + link['lost']} lost, "
        f"{link['delay_median_ms']:.1f} ms on the way (at most {link['delay_max_ms']:.1f})"
    )
sys.exit(0 if one["success"] and two["success"] else 1)
PY
