"""Learn offline, from logged flights, how a UAV collects fresh data at little energy."""

from importlib.util import find_spec

__version__ = "0.1.0"

ENVIRONMENT_ID = "uavrl/DataCollection-v0"

if find_spec("gymnasium") is not None:  # the on-board runtime needs numpy and onnxruntime alone
    import gymnasium

    if ENVIRONMENT_ID not in gymnasium.registry:
        gymnasium.register(
            id=ENVIRONMENT_ID,
            entry_point="uavrl.simulation.environment:DataCollectionEnv",
            vector_entry_point="uavrl.simulation.environment:DataCollectionVectorEnv",
        )
