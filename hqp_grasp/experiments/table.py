"""Rows as a table whose fields say what they mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pyarrow as pa

KINDS = {"text": pa.string(), "bool": pa.bool_(), "count": pa.int64()}


def table_of(rows: Sequence[Mapping[str, object]], about: Mapping[str, str]) -> pa.Table:
    """The columns that `about` names, null where a row lacks one.

    `about` gives each column's unit and meaning, "N: …"; text, bool and count are kinds, what has
    another unit is a number.
    """
    fields = [
        pa.field(
            name, KINDS.get(meaning.partition(":")[0], pa.float64()), metadata={"meaning": meaning}
        )
        for name, meaning in about.items()
    ]
    values = {name: [row.get(name) for row in rows] for name in about}
    return pa.table(values, schema=pa.schema(fields))
