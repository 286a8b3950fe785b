"""The default room: 4 x 3 m, 2.5 m high, furnished so that everything that troubles a line scanner is there.

Dark cloth, a glossy black screen, thin legs and a thin pole, round things, a saturated picture, a doorway
into a dark corridor, a window, things that hide others. Room coordinates: x east along the long wall, y
north, the scanner near the middle of the south wall; bearing 0 looks east, 90 deg north.
"""

from __future__ import annotations

import numpy as np

from scanmap.twin.mesh import Mesh, box, cylinder, merged, quad, sphere, wall_with_hole
from scanmap.twin.room import Room, Thing, assembled, cuboid_walls
from scanmap.twin.texture import Material, boards, painting, plaster, slats, stripes, wood

LENGTH, WIDTH, HEIGHT = 4.0, 3.0, 2.5
SCANNER_POSITION_M = (2.0, 0.42)
DOOR = (2.55, 3.40, 0.0, 2.05)  # start, end, bottom, top along the north wall [m]
WINDOW = (0.95, 1.75, 0.95, 2.05)
THICKNESS, CORRIDOR = 0.14, 1.30  # of the north wall; depth of the corridor behind it [m]

Part = tuple[Thing, Mesh]


def furnished_room(window_radiance: float, rng: np.random.Generator) -> Room:
    """The room; its window shines with `window_radiance` [fraction of saturation], or has its blind down at 0."""
    walls, footprint = cuboid_walls(LENGTH, WIDTH, HEIGHT)
    parts = [
        *_shell(rng), *_corridor(), *_window(window_radiance), *_table(rng), *_chair(rng), *_seat(),
        *_storage(rng), *_small_things(rng),
    ]  # fmt: skip
    lamps = [(1.9, 1.45, 2.46), (2.97, WIDTH + THICKNESS + 0.6, 2.2)]
    return assembled("furnished", parts, lamps, walls, footprint)


def _shell(rng: np.random.Generator) -> list[Part]:
    paint = plaster(rng)
    white, accent = Material((0.80, 0.78, 0.74), texture=paint), Material((0.62, 0.70, 0.72), texture=paint)
    half = LENGTH / 2
    door = (DOOR[0] - half, DOOR[1] - half, DOOR[2], DOOR[3])
    north = merged(
        [
            wall_with_hole([0, WIDTH, 0], [half, 0, 0], [0, 0, HEIGHT], WINDOW),
            wall_with_hole([half, WIDTH, 0], [half, 0, 0], [0, 0, HEIGHT], door),
        ]
    )
    floor = Material((0.42, 0.27, 0.16), texture=boards(rng, (0.0, 0.0, 0.0), 1.9, 1.04))
    thick, high = 0.012, 0.07
    skirting = [
        quad([0, thick, 0], [0, 0, high], [LENGTH, 0, 0]), quad([0, 0, high], [LENGTH, 0, 0], [0, thick, 0]),
        quad([thick, 0, 0], [0, WIDTH, 0], [0, 0, high]), quad([0, 0, high], [thick, 0, 0], [0, WIDTH, 0]),
    ]  # fmt: skip
    return [
        (Thing("floor", floor), quad([0, 0, 0], [LENGTH, 0, 0], [0, WIDTH, 0])),
        (Thing("ceiling", Material((0.84, 0.84, 0.82))), quad([0, 0, HEIGHT], [0, WIDTH, 0], [LENGTH, 0, 0])),
        (Thing("wall_south", white), quad([0, 0, 0], [0, 0, HEIGHT], [LENGTH, 0, 0])),
        (Thing("wall_north", white), north),
        (Thing("wall_west", accent), quad([0, 0, 0], [0, WIDTH, 0], [0, 0, HEIGHT])),
        (Thing("wall_east", white), quad([LENGTH, 0, 0], [0, 0, HEIGHT], [0, WIDTH, 0])),
        (Thing("skirting", Material((0.70, 0.69, 0.66))), merged(skirting)),
    ]


def _reveal(hole: tuple[float, float, float, float], depth: float) -> Mesh:
    """The sides of a hole in the north wall, seen from inside it."""
    x0, x1, z0, z1 = hole
    along, up, through = [x1 - x0, 0, 0], [0, 0, z1 - z0], [0, depth, 0]
    sides = [
        quad([x0, WIDTH, z0], through, up), quad([x1, WIDTH, z0], up, through), quad([x0, WIDTH, z1], through, along),
    ]  # fmt: skip
    return merged(sides if z0 == 0 else [*sides, quad([x0, WIDTH, z0], along, through)])


def _corridor() -> list[Part]:
    y0, y1, x0, x1, top = WIDTH + THICKNESS, WIDTH + THICKNESS + CORRIDOR, 1.9, 3.9, 2.3
    walls = [
        quad([x0, y1, 0], [x1 - x0, 0, 0], [0, 0, top]),
        quad([x0, y0, 0], [0, CORRIDOR, 0], [0, 0, top]),
        quad([x1, y0, 0], [0, 0, top], [0, CORRIDOR, 0]),
        wall_with_hole([x1, y0, 0], [x0 - x1, 0, 0], [0, 0, top], (x1 - DOOR[1], x1 - DOOR[0], DOOR[2], DOOR[3])),
    ]
    floor = quad([x0, WIDTH, 0], [x1 - x0, 0, 0], [0, y1 - WIDTH, 0])
    return [
        (Thing("door_frame", Material((0.72, 0.70, 0.66))), _reveal(DOOR, THICKNESS)),
        (Thing("corridor_walls", Material((0.52, 0.58, 0.50))), merged(walls)),
        (Thing("corridor_floor", Material((0.30, 0.29, 0.28))), floor),
        (
            Thing("corridor_ceiling", Material((0.75, 0.75, 0.73))),
            quad([x0, y0, top], [0, CORRIDOR, 0], [x1 - x0, 0, 0]),
        ),
    ]


def _window(radiance: float) -> list[Part]:
    x0, x1, z0, z1 = WINDOW
    y = WIDTH + 0.10
    pane = quad([x0, y, z0], [x1 - x0, 0, 0], [0, 0, z1 - z0])
    if radiance > 0:
        shining = Material((0.05, 0.05, 0.05), emission=(0.90 * radiance, radiance, 1.08 * radiance))
        glass = Thing("window", shining, measurable=False)
    else:
        slatted = slats(14, np.array([x0, y, z0]), np.array([0.0, 0.0, 1.0 / (z1 - z0)]))
        glass = Thing("blind", Material((0.66, 0.64, 0.58), texture=slatted))
    bars = [
        box([0.5 * (x0 + x1), y - 0.02, 0.5 * (z0 + z1)], [0.05, 0.04, z1 - z0]),
        box([0.5 * (x0 + x1), y - 0.02, z0 + 0.03], [x1 - x0, 0.04, 0.06]),
        box([0.5 * (x0 + x1), y - 0.02, z1 - 0.03], [x1 - x0, 0.04, 0.06]),
        box([0.5 * (x0 + x1), WIDTH - 0.03, z0 - 0.015], [x1 - x0 + 0.16, 0.2, 0.03]),
    ]
    return [
        (glass, pane),
        (Thing("window_frame", Material((0.78, 0.78, 0.76))), merged([_reveal(WINDOW, 0.10), *bars])),
    ]


def _table(rng: np.random.Generator) -> list[Part]:
    centre, yaw, top = np.array([3.12, 1.62, 0.0]), 14.0, 0.74
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))

    def on(x: float, y: float, z: float) -> list[float]:
        return [centre[0] + c * x - s * y, centre[1] + s * x + c * y, z]

    beech = Material((0.52, 0.36, 0.20), texture=wood(rng, 0.5, (c, s, 0.0)))
    legs = [cylinder(on(x, y, 0.0), 0.024, top - 0.03) for x in (-0.58, 0.58) for y in (-0.30, 0.30)]
    screen = [
        box(on(0.10, 0.16, top + 0.27), [0.54, 0.025, 0.32], yaw + 8.0),
        box(on(0.10, 0.17, top + 0.07), [0.05, 0.03, 0.14], yaw),
        box(on(0.10, 0.17, top + 0.006), [0.24, 0.17, 0.012], yaw),
    ]  # fmt: skip
    books = [
        (0.000, (0.21, 0.15, 0.035), 8.0, (0.45, 0.07, 0.06)),
        (0.035, (0.19, 0.14, 0.028), -4.0, (0.10, 0.22, 0.42)),
        (0.063, (0.17, 0.12, 0.022), 17.0, (0.75, 0.62, 0.20)),
    ]
    stack = [
        (Thing(f"book_{k}", Material(colour)), box(on(-0.38, 0.02, top + z + size[2] / 2), size, yaw + turn))
        for k, (z, size, turn, colour) in enumerate(books)
    ]
    return [
        (Thing("table", beech), merged([box(on(0, 0, top - 0.015), [1.28, 0.72, 0.03], yaw), *legs])),
        (Thing("screen", Material((0.018, 0.018, 0.020), gloss=0.06)), merged(screen)),
        (Thing("mug", Material((0.70, 0.16, 0.10), gloss=0.02)), cylinder(on(-0.16, -0.20, top), 0.041, 0.095)),
        (Thing("lemon", Material((0.80, 0.62, 0.06))), sphere(on(0.36, -0.18, top + 0.075), 0.075)),
        *stack,
    ]


def _chair(rng: np.random.Generator) -> list[Part]:
    x, y = 2.62, 1.06
    frame = [box([x + dx, y + dy, 0.225], [0.035, 0.035, 0.45], 0) for dx in (-0.18, 0.18) for dy in (-0.18, 0.18)]
    back = [box([x + dx, y - 0.19, 0.68], [0.03, 0.03, 0.44]) for dx in (-0.18, 0.18)]
    rails = [box([x, y - 0.19, z], [0.36, 0.022, 0.055]) for z in (0.62, 0.74, 0.87)]
    seat = box([x, y, 0.465], [0.42, 0.42, 0.03])
    ash = Material((0.60, 0.47, 0.30), texture=wood(rng, 0.4, (0.0, 0.0, 1.0)))
    return [(Thing("chair", ash), merged([*frame, *back, *rails, seat]))]


def _seat() -> list[Part]:
    cloth = Material((0.030, 0.036, 0.060))
    x, y, yaw = 1.92, 2.36, -8.0
    pieces = [
        box([x, y, 0.22], [0.74, 0.70, 0.36], yaw),
        box([x + 0.04, y + 0.30, 0.56], [0.74, 0.16, 0.62], yaw),
        box([x - 0.38, y - 0.02, 0.36], [0.14, 0.72, 0.56], yaw),
        box([x + 0.38, y + 0.06, 0.36], [0.14, 0.72, 0.56], yaw),
    ]
    cushion = Material((0.55, 0.30, 0.08))
    return [
        (Thing("armchair", cloth), merged(pieces)),
        (Thing("cushion", cushion), box([x - 0.03, y + 0.17, 0.57], [0.36, 0.10, 0.34], 6.0)),
    ]


def _storage(rng: np.random.Generator) -> list[Part]:
    oak = Material((0.36, 0.24, 0.13), texture=wood(rng, 0.7, (0.0, 0.0, 1.0)))
    gap = Material((0.05, 0.04, 0.03))
    lines = [box([0.4655, 2.10, 1.0], [0.003, 0.008, 1.84]), box([0.4655, 2.10, 0.62], [0.003, 1.06, 0.008])]
    knobs = [cylinder([0.478, 2.10 + d, 1.02], 0.012, 0.05) for d in (-0.05, 0.05)]
    carton = Material((0.46, 0.33, 0.20))
    tape = Material((0.55, 0.44, 0.30))
    return [
        (Thing("cupboard", oak), box([0.235, 2.10, 0.96], [0.46, 1.10, 1.92])),
        (Thing("cupboard_gaps", gap), merged(lines)),
        (Thing("knobs", Material((0.30, 0.30, 0.30), gloss=0.2)), merged(knobs)),
        (Thing("carton", carton), box([2.72, 0.60, 0.30], [0.44, 0.36, 0.60], 11.0)),
        (Thing("carton_top", carton), box([2.74, 0.61, 0.735], [0.34, 0.30, 0.27], -7.0)),
        (Thing("carton_tape", tape), box([2.74, 0.61, 0.871], [0.342, 0.05, 0.002], -7.0)),
    ]


def _small_things(rng: np.random.Generator) -> list[Part]:
    corner, across, down = (
        np.array([LENGTH - 0.02, 1.95, 1.95]),
        np.array([0, -1 / 0.95, 0]),
        np.array([0, 0, -1 / 0.68]),
    )
    canvas = Material((0.9, 0.9, 0.9), texture=painting(rng, corner, across, down))
    picture = box([LENGTH - 0.0125, 1.475, 1.61], [0.025, 0.95, 0.68])
    pole = [cylinder([3.72, 2.66, 0.0], 0.13, 0.02), cylinder([3.72, 2.66, 0.0], 0.011, 1.55)]
    leaves = [
        sphere([0.48, 0.62, 0.72], 0.17, 24),
        sphere([0.58, 0.69, 0.60], 0.12, 24),
        sphere([0.38, 0.67, 0.64], 0.12, 24),
        sphere([0.50, 0.51, 0.62], 0.13, 24),
    ]
    column = Material((0.70, 0.69, 0.66), texture=plaster(rng, 0.8))
    rug = Material((0.34, 0.10, 0.09), texture=stripes(7, 0.7, 0.45, np.array([1.0, 0, 0]), np.array([1 / 1.1, 0, 0])))
    return [
        (Thing("picture", canvas), picture),
        (Thing("column", column), cylinder([1.12, 1.42, 0.0], 0.11, HEIGHT - 1e-3, sides=64)),
        (Thing("lamp_stand", Material((0.10, 0.10, 0.10), gloss=0.05)), merged(pole)),
        (Thing("lamp_shade", Material((0.75, 0.70, 0.58))), cylinder([3.72, 2.66, 1.55], 0.19, 0.24, 0.12)),
        (Thing("plant_pot", Material((0.45, 0.18, 0.09))), cylinder([0.48, 0.62, 0.0], 0.13, 0.42, 0.17)),
        (Thing("plant", Material((0.06, 0.20, 0.05))), merged(leaves)),
        (Thing("rug", rug), box([1.72, 1.30, 0.004], [1.1, 0.8, 0.008])),
    ]
