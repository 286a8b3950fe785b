"""How the laser line is looked for: the settings of `[laserline]`."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from scanmap.laserline.grey import Grey


class LaserLineParams(BaseModel, frozen=True, extra="forbid"):
    """How a row's peak is found; `[laserline]` in a rig's TOML."""

    method: Literal["gauss", "cog", "brightest"] = Field(
        "gauss", description="gauss: fit at the noise bound; cog: centre of gravity; brightest: the thesis, exactly"
    )
    grey: Grey = Field("auto", description="plane the line is looked for in; auto: the channel where it stands out")
    bit_index: int = Field(16, ge=0, le=24, description="for grey = bit_index: lowest of the 8 bits, 0 blue to 24")
    noise: Literal["auto", "additive", "speckle"] = Field(
        "auto", description="what scatters the samples; auto judges from the image"
    )
    min_peak: float = Field(
        3.0, gt=0, le=255, description="least height of the line above its background [grey levels]"
    )
    min_snr: float = Field(6.0, ge=2, le=100, description="least signal to noise of the line in its row")
    max_width_px: float = Field(12.0, gt=1, le=14, description="widest profile taken for the line, as sigma [px]")
    off_threshold: float = Field(
        0.0, ge=0, le=255, description="with a laser-off frame: differences below this count as none [grey levels]"
    )
    pool_rows: int = Field(0, ge=0, le=31, description="rows along the line that a column draws on; 0 = its own only")


def needs_colour(params: LaserLineParams) -> bool:
    """Whether the line is looked for in colour; if not, decoding to luminance (the JPEG's own plane) will do."""
    return params.grey not in ("luminance_601", "ycbcr_y")
