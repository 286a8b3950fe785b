"""Render an .rrd of scanmap to a PNG without a display: `python benchmarks/screenshot.py room.rrd room.png --tab scan`.

Needs a Vulkan driver; without a graphics card Mesa's lavapipe serves (Debian: mesa-vulkan-drivers).
"""

import argparse
from pathlib import Path

from scanmap.view.entities import TABS
from scanmap.view.picture import render


def main() -> None:
    """Parse the command line and render."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rrd", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--tab", choices=TABS, default="scan")
    parser.add_argument("--shot", type=int, help="at which shot; the last if left out")
    parser.add_argument("--size", default="1600x1000", metavar="WxH", help="of the picture [px]")
    given = parser.parse_args()
    width, height = (int(n) for n in given.size.split("x"))
    render(given.rrd, given.png, tab=given.tab, width=width, height=height, shot=given.shot)


if __name__ == "__main__":
    main()
