# SPDX-License-Identifier: Apache-2.0
"""Household shapes from parameters: name, mass, friction and pieces. Lengths in m, kg; sizes such as real ones have."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from openarm_common import se3
from openarm_evaluation.objects.pieces import Piece, Rgb, arc, box, ellipsoid, hull, lathe, prism, shell, tube

STEEL: Rgb = (0.62, 0.63, 0.65)
WOOD: Rgb = (0.62, 0.44, 0.26)
WHITE: Rgb = (0.90, 0.89, 0.86)
BLACK: Rgb = (0.09, 0.09, 0.10)
RED: Rgb = (0.72, 0.13, 0.11)
BLUE: Rgb = (0.13, 0.30, 0.62)
GREEN: Rgb = (0.22, 0.48, 0.20)
YELLOW: Rgb = (0.90, 0.76, 0.15)
ORANGE: Rgb = (0.88, 0.45, 0.10)
CREAM: Rgb = (0.90, 0.83, 0.68)
BROWN: Rgb = (0.38, 0.24, 0.14)
TEAL: Rgb = (0.10, 0.47, 0.50)
GREY: Rgb = (0.42, 0.43, 0.45)

_ALONG_X = se3.rot_y(math.pi / 2.0)[:3, :3]


@dataclass(frozen=True)
class Household:
    """An object as it is made.

    Attributes:
        mass: kg.
        pieces: Pieces that it is made of.
        friction: Sliding, against table and objects.
    """

    mass: float
    pieces: list[Piece]
    friction: float = 0.6


def _mug() -> Household:
    body = shell([(0.036, 0.0), (0.040, 0.095)], [(0.032, 0.006), (0.036, 0.095)], BLUE)
    turn = np.linspace(-math.pi / 2.0, math.pi / 2.0, 9)
    path = np.stack([0.036 + 0.030 * np.cos(turn), 0.0 * turn, 0.048 + 0.030 * np.sin(turn)], axis=1)
    return Household(0.32, [body, tube(path, [[0.008, 0.005]] * 9, BLUE, up=(0.0, 1.0, 0.0), around=8)])


def _bowl() -> Household:
    turn = np.linspace(0.35, 1.35, 4)
    outer = [(0.078 * math.sin(t), 0.078 * (1.0 - math.cos(t)) - 0.0047) for t in turn]
    inner = [(r - 0.005, z + 0.004 * (1.0 - k / 3.0)) for k, (r, z) in enumerate(outer)]
    return Household(0.28, [shell(outer, inner, CREAM)])


def _bottle() -> Household:
    body = [(0.030, 0.0), (0.033, 0.006), (0.033, 0.135), (0.026, 0.160), (0.0135, 0.178), (0.0135, 0.190)]
    label = lathe([(0.0335, 0.045), (0.0335, 0.110)], WHITE).labelled(WHITE, RED, WHITE, BLUE, WHITE)
    return Household(0.35, [lathe(body, TEAL), lathe([(0.0155, 0.188), (0.0155, 0.208)], WHITE), label])


def _spray_bottle() -> Household:
    flat = np.array([1.0, 0.62, 1.0])
    body = lathe([(0.042, 0.0), (0.044, 0.01), (0.044, 0.09), (0.030, 0.125), (0.018, 0.145)], BLUE)
    head = box((0.085, 0.026, 0.026), WHITE, (0.012, 0.0, 0.185), 0.004)
    trigger = tube([(0.035, 0.0, 0.178), (0.042, 0.0, 0.155), (0.034, 0.0, 0.132)], 0.005, RED, up=(0, 1, 0), around=8)
    pieces = [body.bent(lambda p: p * flat).labelled(BLUE, BLUE, WHITE, YELLOW, BLUE), head, trigger]
    return Household(0.30, [*pieces, lathe([(0.014, 0.14), (0.014, 0.178)], WHITE)])


def _banana() -> Household:
    turn = np.linspace(-0.85, 0.85, 11)
    path = np.c_[0.115 * np.sin(turn), 0.115 * (np.cos(turn) - 0.85), 0.0 * turn]
    radii = [0.005, 0.010, 0.0155, 0.018, 0.019, 0.0195, 0.019, 0.018, 0.015, 0.009, 0.005]
    tip = tube(path[[0, 1]] + [(-0.006, -0.007, 0.0), (0.0, 0.0, 0.0)], [0.004, 0.005], BROWN, around=8)
    return Household(0.12, [tube(path, radii, YELLOW), tip], 0.5)


def _pear() -> Household:
    profile = [(0.012, 0.0), (0.024, 0.006), (0.032, 0.020), (0.034, 0.034), (0.029, 0.052), (0.019, 0.070),
               (0.016, 0.082), (0.010, 0.091), (0.003, 0.093)]  # fmt: skip
    stem = tube([(0.0, 0.0, 0.09), (0.002, 0.0, 0.098), (0.006, 0.0, 0.106)], 0.002, BROWN, up=(0, 1, 0), around=6)
    return Household(0.17, [lathe(profile, (0.62, 0.68, 0.25)), stem], 0.5)


def _apple() -> Household:
    profile = [(0.008, 0.006), (0.016, 0.0), (0.027, 0.008), (0.035, 0.026), (0.0365, 0.040), (0.032, 0.056),
               (0.022, 0.066), (0.010, 0.064)]  # fmt: skip
    stem = tube([(0.0, 0.0, 0.058), (0.002, 0.0, 0.066), (0.005, 0.0, 0.074)], 0.0018, BROWN, up=(0, 1, 0), around=6)
    return Household(0.15, [lathe(profile, RED), stem], 0.5)


def _egg() -> Household:
    turn = np.linspace(0.0, math.pi, 13)
    profile = [(0.022 * math.sin(t) * (1.0 + 0.12 * math.cos(t)), -0.029 * math.cos(t)) for t in turn]
    return Household(0.06, [lathe(profile, CREAM)], 0.5)


def _ball() -> Household:
    return Household(0.058, [ellipsoid((0.033, 0.033, 0.033), (0.70, 0.80, 0.22), rows=12)], 0.7)


def _melon() -> Household:
    return Household(0.9, [ellipsoid((0.060, 0.055, 0.055), GREEN)], 0.5)


def _spoon() -> Household:
    x = np.linspace(-0.085, 0.055, 8)
    z = 0.006 + 0.006 * np.sin(np.linspace(0.0, 2.6, 8))
    widths = [0.009, 0.010, 0.009, 0.007, 0.005, 0.004, 0.004, 0.006]
    handle = tube(np.c_[x, 0.0 * x, z], np.c_[np.full(8, 0.0022), widths], STEEL, around=8)
    dish = ellipsoid((0.030, 0.020, 0.006), STEEL, (0.082, 0.0, 0.006))
    return Household(0.055, [handle, dish], 0.4)


def _scissors() -> Household:
    pieces: list[Piece] = []
    for sign, low in ((1.0, 0.002), (-1.0, 0.006)):
        blade = np.array([(-0.005, 0.009), (-0.005, -0.006), (0.095, 0.004), (0.098, 0.007)])
        shank = np.array([(0.010, -0.008), (0.010, 0.006), (-0.045, 0.030), (-0.048, 0.016)])
        flip = np.array([1.0, sign])
        pieces += prism([blade * flip], low, low + 0.004, STEEL)
        pieces += prism([(shank * flip)], low - 0.001, low + 0.006, BLACK)
        ring = np.c_[arc(1.0, 0.0, math.tau * 11 / 12, 12), np.zeros(12)] * (0.026, 0.017, 0.0)
        centre = (-0.068, 0.030 * sign, low + 0.003)
        pieces.append(tube(ring + centre, [[0.005, 0.0045]] * 12, RED, closed=True, around=8))
    return Household(0.09, pieces, 0.4)


def _screwdriver() -> Household:
    grip = [(0.010, 0.0), (0.015, 0.006), (0.0165, 0.030), (0.014, 0.060), (0.016, 0.085), (0.010, 0.100)]
    handle = lathe(grip, ORANGE, 12).labelled(BLACK, ORANGE, ORANGE, ORANGE, BLACK)
    shaft = lathe([(0.0035, 0.095), (0.0035, 0.190)], STEEL, 8)
    blade = hull([(x, y, z) for x, y, z in ((0.0035, 0.0035, 0.185), (0.0045, 0.0008, 0.205))
                  for x in (-x, x) for y in (-y, y)], STEEL)  # fmt: skip
    return Household(0.11, [piece.moved(_ALONG_X) for piece in (handle, shaft, blade)])


def _hammer() -> Household:
    x = np.linspace(0.0, 0.27, 7)
    grip = [[0.013, 0.0165], [0.0145, 0.018], [0.014, 0.017], [0.012, 0.014], [0.011, 0.013], [0.0105, 0.0125],
            [0.0105, 0.0125]]  # fmt: skip
    handle = tube(np.c_[x, 0.0 * x, 0.0 * x], grip, WOOD)
    head = box((0.024, 0.050, 0.024), STEEL, (0.283, 0.0, 0.0), 0.003)
    face = lathe([(0.012, 0.0), (0.0145, 0.006), (0.0145, 0.026), (0.012, 0.030)], STEEL, 16)
    face = face.moved(se3.rot_x(math.pi / 2.0)[:3, :3], (0.283, -0.022, 0.0))
    claws = [
        hull([(0.283 + a, y, z) for y, a, z in ((0.022, 0.011, 0.011), (0.022, -0.011, 0.011), (0.022, 0.011, 0.002),
             (0.022, -0.011, 0.002), (0.062, -0.006, 0.011), (0.062, -0.011, 0.006), (0.062, -0.006, 0.006))], STEEL)
    ]  # fmt: skip
    claws.append(claws[0].bent(lambda p: p * (1.0, 1.0, -1.0)))
    claws[1] = hull(claws[1].vertices, STEEL)
    return Household(0.55, [handle, head, face, *claws])


def _clamp() -> Household:
    pieces: list[Piece] = []
    for sign in (1.0, -1.0):
        flip = np.array([1.0, sign])
        grip = np.array([(-0.080, 0.040), (-0.076, 0.030), (0.000, 0.004), (0.004, 0.016)])
        jaw = np.array([(-0.002, 0.003), (-0.002, 0.017), (0.050, 0.024), (0.050, 0.012)])
        tip = np.array([(0.038, 0.002), (0.038, 0.018), (0.060, 0.022), (0.060, 0.002)])
        pieces += prism([grip * flip, jaw * flip], 0.0, 0.024, BLACK)
        pieces += prism([tip * flip], 0.002, 0.022, ORANGE)
    return Household(0.10, [*pieces, lathe([(0.009, -0.002), (0.009, 0.026)], STEEL, 16)])


def _wrench() -> Household:
    bar = np.array([(-0.060, -0.008), (-0.060, 0.008), (0.060, 0.010), (0.060, -0.010)])
    base = np.array([(0.055, -0.017), (0.055, 0.017), (0.072, 0.020), (0.072, -0.020)])
    upper = np.array([(0.070, 0.008), (0.070, 0.020), (0.092, 0.016), (0.092, 0.008)])
    eye = np.c_[arc(0.0125, 0.0, math.tau * 15 / 16, 16, (-0.070, 0.0)), np.full(16, 0.005)]
    pieces = prism([bar], 0.0015, 0.0085, STEEL) + prism([base, upper, upper * (1.0, -1.0)], 0.0, 0.010, STEEL)
    return Household(0.16, [*pieces, tube(eye, [[0.005, 0.0045]] * 16, STEEL, closed=True, around=8)], 0.4)


def _wedge() -> Household:
    corners = [(0.0, 0.0), (0.090, 0.0), (0.0, 0.045)]
    return Household(0.10, [hull([(x, y, z) for x, z in corners for y in (-0.022, 0.022)], WOOD)])


def _torus() -> Household:
    ring = np.c_[arc(0.040, 0.0, math.tau * 19 / 20, 20), np.full(20, 0.013)]
    return Household(0.09, [tube(ring, 0.013, RED, closed=True)], 0.7)


def _tube() -> Household:
    rims = [(0.029, 0.0), (0.029, 0.110)], [(0.025, 0.0), (0.025, 0.110)]
    return Household(0.06, [shell(*rims, BROWN)])


def _tape() -> Household:
    rims = [(0.048, 0.0), (0.048, 0.025)], [(0.038, 0.0), (0.038, 0.025)]
    return Household(0.11, [shell(*rims, CREAM)], 0.7)


def _thin_box() -> Household:
    return Household(0.15, [box((0.120, 0.078, 0.020), RED, bevel=0.001).labelled(RED, WHITE, RED)])


def _cereal_box() -> Household:
    return Household(0.35, [box((0.058, 0.150, 0.200), YELLOW, bevel=0.001).labelled(YELLOW, GREEN, WHITE, GREEN)])


def _sponge() -> Household:
    soft = box((0.090, 0.062, 0.026), YELLOW, (0.0, 0.0, 0.013), 0.003)
    return Household(0.03, [soft, box((0.090, 0.062, 0.008), GREEN, (0.0, 0.0, 0.030), 0.002)], 0.9)


def _star() -> Household:
    tips, dents = (
        arc(0.044, math.pi / 2.0, math.pi / 2.0 + math.tau * 0.8, 5),
        arc(0.021, 0.3 * math.pi, 1.9 * math.pi, 5),
    )
    rays = [np.stack([dents[k], tips[k], dents[(k + 1) % 5]]) for k in range(5)]
    return Household(0.07, prism([dents, *rays], 0.0, 0.026, YELLOW))


def _drink_can() -> Household:
    profile = [(0.026, 0.0), (0.033, 0.008), (0.033, 0.104), (0.027, 0.115)]
    return Household(0.34, [lathe(profile, RED).labelled(STEEL, RED, WHITE, RED, RED, STEEL)], 0.5)


def _goblet() -> Household:
    foot = lathe([(0.034, 0.0), (0.034, 0.003), (0.006, 0.010), (0.005, 0.070), (0.012, 0.078)], TEAL)
    cup = shell(
        [(0.012, 0.076), (0.032, 0.098), (0.034, 0.140)], [(0.010, 0.080), (0.029, 0.100), (0.031, 0.140)], TEAL
    )
    return Household(0.18, [foot, cup], 0.4)


def _plate() -> Household:
    outer = [(0.060, 0.0), (0.095, 0.016)]
    return Household(0.40, [shell(outer, [(0.056, 0.005), (0.091, 0.019)], WHITE, 20)])


def _pan() -> Household:
    dish = shell([(0.075, 0.0), (0.088, 0.038)], [(0.071, 0.005), (0.084, 0.038)], BLACK)
    x = np.linspace(0.083, 0.225, 5)
    handle = tube(np.c_[x, 0.0 * x, 0.032 + 0.10 * (x - 0.083)], [[0.007, 0.011]] * 5, WOOD)
    return Household(0.65, [dish, handle], 0.5)


def _brush() -> Household:
    x = np.linspace(-0.11, 0.045, 7)
    widths = [0.006, 0.012, 0.0135, 0.012, 0.010, 0.011, 0.016]
    handle = tube(np.c_[x, 0.0 * x, np.full(7, 0.034)], np.c_[np.full(7, 0.008), widths], WOOD)
    return Household(0.10, [handle, box((0.070, 0.042, 0.012), WOOD, (0.072, 0.0, 0.034), 0.004),
                            box((0.064, 0.036, 0.028), WHITE, (0.072, 0.0, 0.014))])  # fmt: skip


def _mouse() -> Household:
    dome = ellipsoid((0.055, 0.031, 0.036), GREY)
    points = dome.vertices[dome.vertices[:, 2] >= -1e-9]
    return Household(0.09, [hull(points, GREY), box((0.018, 0.005, 0.008), BLACK, (0.034, 0.0, 0.026))], 0.4)


def _toy_car() -> Household:
    wheel = lathe([(0.013, -0.005), (0.013, 0.005)], BLACK, 16).moved(se3.rot_x(math.pi / 2.0)[:3, :3])
    wheels = [wheel.moved(None, (x, y, 0.013)) for x in (-0.032, 0.032) for y in (-0.024, 0.024)]
    cabin = hull([(x * s, y, z) for x, z in ((0.030, 0.038), (0.018, 0.058)) for s in (-1.0, 1.0)
                  for y in (-0.019, 0.019)], WHITE)  # fmt: skip
    return Household(0.12, [box((0.110, 0.046, 0.026), ORANGE, (0.0, 0.0, 0.027), 0.005), cabin, *wheels])


def _dumbbell() -> Household:
    end = lathe([(0.022, 0.0), (0.026, 0.005), (0.026, 0.030), (0.022, 0.035)], TEAL, 6)
    bar = lathe([(0.012, -0.062), (0.014, 0.0), (0.012, 0.062)], STEEL, 16)
    pieces = [end.moved(None, (0.0, 0.0, 0.055)), end.moved(None, (0.0, 0.0, -0.090)), bar]
    return Household(0.75, [piece.moved(_ALONG_X) for piece in pieces])


def _carton() -> Household:
    low = [(x, y, z) for x in (-0.033, 0.033) for y in (-0.033, 0.033) for z in (0.0, 0.125)]
    roof = [*((x, y, 0.125) for x in (-0.033, 0.033) for y in (-0.033, 0.033)),
            *((x, y, 0.158) for x in (-0.033, 0.033) for y in (-0.003, 0.003))]  # fmt: skip
    fin = box((0.066, 0.006, 0.016), WHITE, (0.0, 0.0, 0.165))
    return Household(0.40, [hull(low, WHITE).labelled(BLUE, WHITE, WHITE, BLUE, WHITE), hull(roof, WHITE), fin])


def _duck() -> Household:
    body = ellipsoid((0.042, 0.030, 0.026), YELLOW, (0.0, 0.0, 0.026))
    tail = hull([(-0.030, y, 0.030) for y in (-0.015, 0.015)] + [(-0.030, 0.0, 0.044), (-0.052, 0.0, 0.050)], YELLOW)
    beak = ellipsoid((0.013, 0.009, 0.004), ORANGE, (0.046, 0.0, 0.060), 6)
    return Household(0.06, [body, ellipsoid((0.021, 0.020, 0.020), YELLOW, (0.022, 0.0, 0.064)), tail, beak], 0.7)


def _bracket() -> Household:
    leg = [
        box((0.080, 0.030, 0.012), GREY, (0.040, 0.0, 0.006)),
        box((0.012, 0.030, 0.065), GREY, (0.006, 0.0, 0.0325)),
    ]
    return Household(0.20, leg, 0.4)


#: Makers by name.
HOUSEHOLD: dict[str, Callable[[], Household]] = {
    "apple": _apple, "ball": _ball, "banana": _banana, "bottle": _bottle, "bowl": _bowl, "bracket": _bracket,
    "brush": _brush, "carton": _carton, "cereal_box": _cereal_box, "clamp": _clamp, "drink_can": _drink_can,
    "duck": _duck, "dumbbell": _dumbbell, "egg": _egg, "goblet": _goblet, "hammer": _hammer, "melon": _melon,
    "mouse": _mouse, "mug": _mug, "pan": _pan, "pear": _pear, "plate": _plate, "scissors": _scissors,
    "screwdriver": _screwdriver, "sponge": _sponge, "spoon": _spoon, "spray_bottle": _spray_bottle, "star": _star,
    "tape": _tape, "thin_box": _thin_box, "torus": _torus, "toy_car": _toy_car, "tube": _tube, "wedge": _wedge,
    "wrench": _wrench,
}  # fmt: skip
