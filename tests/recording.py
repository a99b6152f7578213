"""What a replay file says, read without a browser: its messages, and the scene at any time."""

import base64
import re

import msgspec.msgpack
import numpy as np
import zstandard


def messages(page):
    """[(time [s], message)] of a replay's page, its arrays put back in their places."""
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page).group(1))
    inner = zstandard.ZstdDecompressor().decompress(data[8:])
    end = 8 + int.from_bytes(inner[:8], "little")
    told = msgspec.msgpack.decode(inner[8:end])
    buffers, at = [], end
    for length in told["binaryBufferLengths"]:
        at += -at % 8
        buffers.append(inner[at : at + length])
        at += length

    def restored(value):
        if isinstance(value, dict) and "__binary_index" in value:
            return np.frombuffer(buffers[value["__binary_index"]], value["dtype"])
        if isinstance(value, dict):
            return {key: restored(entry) for key, entry in value.items()}
        return value

    return told["durationSeconds"], [(time, restored(m)) for time, m in told["messages"]]


def scene_at(told, time):
    """{name of a node: its properties} at a time."""
    nodes = {}
    for when, message in told:
        if when > time or "name" not in message:
            continue
        node = nodes.setdefault(message["name"], {})
        node.update(message.get("props", {}))
        node.update(message.get("updates", {}))
        node.update({key: message[key] for key in ("position", "wxyz") if key in message})
    return nodes
