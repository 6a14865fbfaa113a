"""Model files: read, and looked through before anything of them runs."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from ground_station.features import inspection
from ground_station.features.extractor import FeatureError
from ground_station.features.model_info import MAX_BYTES, Model, ModelInfo


def read(path: str | Path) -> Model:
    """Reads a model's file and looks through its graph; runs nothing.

    Raises `FeatureError` with one line naming the file: it is not there, too large, cut, not ONNX,
    has other metadata, or a graph that is not a feature network's (see `inspection.check`).
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            # As much as is asked for is set aside, whatever the file has.
            size = os.fstat(file.fileno()).st_size
            data = file.read(min(size, MAX_BYTES) + 1)
    except OSError as error:
        raise FeatureError(f"{path}: {error.strerror or error}") from None
    try:
        if len(data) > MAX_BYTES:
            raise FeatureError(f"more than {MAX_BYTES} bytes, which no model has")
        proto = inspection.parse(data)
        info = ModelInfo.of_metadata({item.key: item.value for item in proto.metadata_props})
        inspection.check(proto, info)
    except FeatureError as error:
        raise FeatureError(f"{path}: {error}") from None
    except (AttributeError, TypeError, ValueError, LookupError) as error:
        # protobuf hands on text that is none as bytes, and numbers beyond what they count.
        raise FeatureError(f"{path}: it is damaged ({type(error).__name__})") from None
    return Model(path, info, data, hashlib.sha256(data).hexdigest())
