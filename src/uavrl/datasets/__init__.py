"""Logged flights: in memory, mapped, as flat files, as Minari datasets; selection, validation and a report on them."""

from uavrl.datasets.flat import load_flat, save_flat, stored_scenario
from uavrl.datasets.mapped import MappedTransitions, save_mapped
from uavrl.datasets.minari_io import free_minari_folder, read_minari, write_minari
from uavrl.datasets.objective import relabelled
from uavrl.datasets.replay import ReplayLog
from uavrl.datasets.report import describe
from uavrl.datasets.selection import Quality, select
from uavrl.datasets.sources import builtin_names, load_builtin, load_parts, load_source
from uavrl.datasets.transitions import COLUMNS, Transitions, concatenate, transition_columns
from uavrl.datasets.validation import validate

__all__ = [
    "COLUMNS",
    "MappedTransitions",
    "Quality",
    "ReplayLog",
    "Transitions",
    "builtin_names",
    "concatenate",
    "describe",
    "free_minari_folder",
    "load_builtin",
    "load_flat",
    "load_parts",
    "load_source",
    "read_minari",
    "relabelled",
    "save_flat",
    "save_mapped",
    "select",
    "stored_scenario",
    "transition_columns",
    "validate",
    "write_minari",
]
