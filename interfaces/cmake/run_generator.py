# SPDX-License-Identifier: Apache-2.0
"""`python run_generator.py GENERATOR ARGUMENT...`: run a generator of rosidl in a quarter of its time.

Each of the six generators parses each interface, and scans a template for each of them again. Here the first generator
keeps what it has parsed in the build folder, and a template is scanned and compiled once. The output is the same.
"""

import functools
import os
import pickle
import runpy
import sys

import em
from rosidl_parser import definition, parser

SCAN = em.Scanner.one
SCANNED = {}


def parse_idl_file(locator):
    """Return the parsed interface, from the file beside it where a generator has left one."""
    path = locator.get_absolute_path()
    kept = path.with_suffix(".parsed")
    if not kept.exists() or kept.stat().st_mtime_ns < path.stat().st_mtime_ns:
        part = path.with_suffix(f".{os.getpid()}")
        part.write_bytes(pickle.dumps(parser.parse_idl_string(path.read_text(encoding="utf-8"))))
        part.rename(kept)  # whole, for a generator that runs at the same time
    return definition.IdlFile(locator, pickle.loads(kept.read_bytes()))


def scan(scanner, firebreaks=None):
    """Return the first part of a template: the one found before where the rest of a template is the same."""
    if scanner.lock or firebreaks:
        return SCAN(scanner, firebreaks)
    text = scanner.rest()
    if text not in SCANNED:
        token = SCAN(scanner)
        SCANNED[text] = token, len(text) - len(scanner)
        return token
    token, length = SCANNED[text]
    scanner.advance(length)
    scanner.sync()
    return token


compiled = functools.cache(compile)
em.Scanner.one = scan
em.evalFunc = lambda code, *scopes: eval(compiled(code.lstrip(), "template", "eval"), *scopes)
em.execFunc = lambda code, *scopes: exec(compiled(code, "template", "exec"), *scopes)
parser.parse_idl_file = parse_idl_file
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
