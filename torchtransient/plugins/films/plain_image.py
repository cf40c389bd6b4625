"""What a time-resolved film is to Mitsuba's own integrators: an ``hdrfilm`` of the same pixels and spatial filter."""

from __future__ import annotations

import mitsuba as mi


def plain_image(film):
    """An ``hdrfilm`` like ``film``, in single precision: RGB, or luminance in monochromatic variants."""
    size, crop, offset = film.size(), film.crop_size(), film.crop_offset()
    return mi.load_dict(
        {
            "type": "hdrfilm",
            "width": int(size[0]),
            "height": int(size[1]),
            "crop_width": int(crop[0]),
            "crop_height": int(crop[1]),
            "crop_offset_x": int(offset[0]),
            "crop_offset_y": int(offset[1]),
            "pixel_format": "luminance" if mi.is_monochromatic else "rgb",
            "component_format": "float32",
            "sample_border": film.sample_border(),
            "rfilter": film.rfilter(),
        }
    )


def bitmap_of(steady, names):
    """The steady image ``(H, W, C)`` as a bitmap; ``names`` of its channels."""
    if tuple(names) in (("L",), ("R", "G", "B")) and steady.shape[2] == len(names):
        return mi.Bitmap(steady)
    stokes = [f"{name}.S{s}" for s in range(4) for name in names] if steady.shape[2] > len(names) else list(names)
    return mi.Bitmap(steady, mi.Bitmap.PixelFormat.MultiChannel, channel_names=stokes)
