# SPDX-License-Identifier: Apache-2.0
"""What ./openarm asks about the machine before there is an environment. It runs on any Python 3: old syntax only.

probe.py python                   prints "X.Y.Z <base interpreter>" and exits 0, or the reason against it and exits 1
probe.py packages [build] [venv]  prints the apt package of each missing system part, one a line
"""

import ctypes
import glob
import importlib.util
import os
import platform
import sys
import sysconfig

# Debian 12 and Ubuntu 24.04 name them alike. libGL brings Mesa's software renderer along.
LIBRARIES = (("libEGL.so.1", "libegl1"), ("libGL.so.1", "libgl1"), ("libgomp.so.1", "libgomp1"))
EGL_VENDORS = ("/usr/share/glvnd/egl_vendor.d/*.json", "/etc/glvnd/egl_vendor.d/*.json")


def refusal():
    """Return why this interpreter cannot be used, or None."""
    version = platform.python_version()
    if platform.python_implementation() != "CPython":
        return "it is %s" % platform.python_implementation()
    if not (3, 11) <= sys.version_info[:2] <= (3, 13):
        return "it is %s" % version
    if sys.maxsize < 2**32:
        return "it is a 32-bit build"
    if sysconfig.get_config_var("Py_GIL_DISABLED"):
        return "it is a free-threaded build"
    libc, libc_version = platform.libc_ver()
    if libc != "glibc" or tuple(map(int, libc_version.split(".")[:2])) < (2, 28):
        return "its C library is %s %s; the wheels need glibc 2.28 or later" % (libc or "unknown", libc_version)
    return None


def missing_packages(parts):
    """Yield the packages that provide what is missing."""
    for library, package in LIBRARIES:
        try:
            ctypes.CDLL(library)
        except OSError:
            yield package
    if not any(glob.glob(pattern) for pattern in EGL_VENDORS):
        yield "libegl-mesa0"
        yield "libgl1-mesa-dri"
    python = "python%d.%d" % sys.version_info[:2]
    if "build" in parts and not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
        yield python + "-dev"
    if "venv" in parts and importlib.util.find_spec("ensurepip") is None:
        yield python + "-venv"


if __name__ == "__main__":
    if sys.argv[1] == "python":
        reason = refusal()
        print(reason or "%s %s" % (platform.python_version(), getattr(sys, "_base_executable", "") or sys.executable))
        sys.exit(reason is not None)
    print("\n".join(missing_packages(sys.argv[2:])))
