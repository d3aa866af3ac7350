"""Contents (dictionaries) -> messages of rclpy."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from functools import cache
from typing import Any


def as_message(kind: Any, content: Mapping[str, Any]) -> Any:
    """Return a message of class ``kind`` with these fields; others have the values that ROS gives them."""
    message = kind()
    for name, value in content.items():
        if isinstance(value, Mapping):
            setattr(message, name, as_message(type(getattr(message, name)), value))
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            element = _class(kind.get_fields_and_field_types()[name])
            setattr(message, name, [as_message(element, one) for one in value])
        else:
            setattr(message, name, value)
    return message


@cache
def _class(sequence: str) -> Any:
    """Return the message class of the elements of a field, such as ``sequence<geometry_msgs/Pose>``."""
    found = re.search(r"(\w+)/(\w+)", sequence)
    assert found is not None, sequence
    return getattr(importlib.import_module(f"{found[1]}.msg"), found[2])
