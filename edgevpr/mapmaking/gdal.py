"""rasterio, which brings GDAL and PROJ, with a sentence where it is missing. All modules that read maps made of
pictures import it from here."""

import logging
import os

from edgevpr.core.errors import SourceError

# Read when GDAL first keeps a block of a file, in MB. Its default is a twentieth of the RAM.
os.environ.setdefault("GDAL_CACHEMAX", "64")

try:
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.crs import CRS
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.features import geometry_mask
    from rasterio.warp import transform
    from rasterio.windows import Window
except ModuleNotFoundError as error:
    raise SourceError(
        f"An orthophoto is read with rasterio, and {error.name} is not installed: pip install 'edgevpr[maps]'."
    ) from error

logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # edgevpr reports each fault once, in its own words

__all__ = [
    "CRS",
    "CPLE_BaseError",
    "ColorInterp",
    "NotGeoreferencedWarning",
    "RasterioError",
    "Resampling",
    "Window",
    "geometry_mask",
    "rasterio",
    "transform",
]
