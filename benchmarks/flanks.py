"""Lines of which one side is another's, on dark joints, of cut beams: how far off before, after, and by sigma.

    python benchmarks/flanks.py [--seeds 6]

The pictures are those of tests/test_clean_flanks.py, test_cut_beams.py, test_joints.py and test_room_light.py; the
picture of them goes to docs/img/flanks.png: rows from above magnified, what a Gaussian fitted to both halves says in
red, the clean flank in green, the truth in white.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scanmap.laserline import by_clean_flanks, find_laser_line

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import test_clean_flanks as lines
import test_cut_beams as beams
import test_joints as joints
import test_room_light as walls

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

KINDS = ("whole", "narrow", "wide", "joint", "stripe", "edge", "gloss")
SHOWN = ("joint", "stripe", "edge", "gloss")
MAGNIFIED, COLUMNS, ROWS = 20, 20, 40


def flanks(seeds: int) -> list[U8]:
    """Print a table of lines, and return pictures of some."""
    print(f"{'line':10s} {'noise':>5s} {'off px':>7s} {'after':>7s} {'moved':>6s} {'z':>5s}")
    pictures = []
    for kind in KINDS:
        for noise in (1.0, 2.0, 4.0):
            before, after, told, z = [], [], [], []
            for seed in range(seeds):
                image = lines.drawn(lines.light(kind, (-1) ** seed), lines.COLUMNS, seed, noise)
                found = find_laser_line(image, lines.PARAMS)
                moved = by_clean_flanks(image, lines.PARAMS, found.column_px, lines.SURE, lines.ALL)
                before.append(found.column_px - lines.COLUMNS)
                after.append(before[-1] + moved.by)
                told.append(moved.by != 0.0)
                z.append(after[-1] / np.hypot(found.sigma_px, moved.doubt))
                if seed == 0 and noise == 2.0 and kind in SHOWN:
                    pictures.append(magnified(kind, image, before[-1], after[-1]))
            middle = [float(np.median(np.abs(np.concatenate(own)))) for own in (before, after)]
            spread = float(np.sqrt(np.mean(np.square(np.concatenate(z)))))
            print(f"{kind:10s} {noise:5.1f} {middle[0]:7.3f} {middle[1]:7.3f} {np.mean(told):6.2f} {spread:5.2f}")
    return pictures


def magnified(kind: str, image: U8, before: F64, after: F64) -> U8:
    """Some rows of a picture around the line, straightened: one below the other, with what was found."""
    shown = np.zeros((ROWS, COLUMNS * MAGNIFIED, 3), np.uint8)
    for row in range(ROWS):
        x = lines.COLUMNS[row] + (np.arange(COLUMNS * MAGNIFIED) / MAGNIFIED - COLUMNS / 2)
        shown[row] = np.minimum(1.7 * np.interp(x, np.arange(image.shape[1]), image[row]), 255.0)[:, None]
    picture = cv2.resize(shown, None, fx=1, fy=6, interpolation=cv2.INTER_NEAREST)
    for row in range(ROWS):
        for off, colour in ((0.0, (255, 255, 255)), (before[row], (60, 60, 255)), (after[row], (60, 220, 60))):
            at = round((off + COLUMNS / 2) * MAGNIFIED)
            cv2.line(picture, (at, 6 * row), (at, 6 * row + 5), colour, 2)
    cv2.putText(picture, kind, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)


def posts() -> None:
    """Print a table of beams of which a post that one bearing meets leaves a share."""
    print(f"\n{'left of a beam':15s} {'off mm':>7s} {'sigma mm':>9s}   with laser-off frames")
    for share in (1.0, 0.65, 0.5, 0.35, 0.2):
        row = f"{share:15.2f}"
        for background in (False, True):
            each = [beams.post_alone(beams.cut_beam(share, side), background) for side in (-1.0, 1.0)]
            off, sigma = (np.concatenate(own) for own in zip(*each, strict=True))
            row += f" {1e3 * np.median(np.abs(off)):7.1f} {1e3 * np.median(sigma):9.1f}  "
        print(row)


def on_joints() -> None:
    """Print a table of lines on dark joints 1.5 px wide, at six places, seen with laser-off frames; rms over places."""
    print(f"\n{'lens px':>7s} {'albedo':>7s} {'off px':>7s} {'after':>7s} {'sigma':>7s}   a shadow's after")
    for lens_px in (0.5, 0.7, 0.9, 1.1, 1.3):
        for albedo in (0.3, 0.5):
            each = []
            for joint_px in (-1.8, -1.0, -0.4, 0.4, 1.0, 1.8):
                painted, dark = (joints.pair(joint_px, 1.5, albedo, shadow, lens_px) for shadow in (False, True))
                off, sigma = joints.off_middle(*painted)
                each.append((joints.plain_fit(*painted[:2]), off, sigma, joints.off_middle(*dark)[0]))
            before, after, sigma, shadow = np.sqrt(np.mean(np.square(each), axis=0))
            print(f"{lens_px:7.1f} {albedo:7.1f} {before:7.3f} {after:7.3f} {sigma:7.3f} {shadow:9.3f}")


def on_walls() -> None:
    """Print a table of lines on joints of a tiled wall, swept without laser-off frames; rms over places, in pixels."""
    print(f"\n{'bearings deg':>12s} {'off px':>7s} {'after':>7s}   other bearings")
    for off_deg in (0.0, 0.05, 0.1, 0.2):
        each = []
        for joint_m in (-0.006, -0.005, -0.0035, -0.002, 0.002, 0.0035, 0.005, 0.006):
            shots = walls.shots(joint_m, off_deg)
            before, after = (walls.swept(shots, settled) for settled in (False, True))
            others = [np.median(walls.off_middle(after, k)) for k in range(len(shots)) if k != walls.ON_JOINT]
            each.append([*(np.median(walls.off_middle(scan)) for scan in (before, after)), np.max(np.abs(others))])
        print(f"{off_deg:12.2f} {'{:7.3f} {:7.3f} {:7.3f}'.format(*np.sqrt(np.mean(np.square(each), axis=0)))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    pictures = flanks(parser.parse_args().seeds)
    posts()
    on_joints()
    on_walls()
    folder = Path(__file__).parent.parent / "docs" / "img"
    cv2.imwrite(str(folder / "flanks.png"), np.hstack(pictures))


if __name__ == "__main__":
    main()
