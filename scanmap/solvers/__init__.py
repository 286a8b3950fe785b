"""What makes a `Calibration` or judges one: boards, the laser plane, the axis, tables, rooms; and designs of heads."""
