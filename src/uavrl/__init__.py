"""Learn offline, from logged flights, how a UAV collects fresh data at little energy."""

from importlib.util import find_spec

__version__ = "0.1.0"

if find_spec("gymnasium") is not None:  # the on-board runtime needs numpy and onnxruntime alone
    import gymnasium

    if "uavrl/DataCollection-v0" not in gymnasium.registry:
        gymnasium.register(
            id="uavrl/DataCollection-v0",
            entry_point="uavrl.simulation.environment:DataCollectionEnv",
            vector_entry_point="uavrl.simulation.environment:DataCollectionVectorEnv",
        )
