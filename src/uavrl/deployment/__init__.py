"""From a checkpoint to one file that flies: `export` needs torch and onnx, `Policy` numpy and onnxruntime alone."""

from uavrl.deployment.runtime import Decision, Policy, PolicyError

__all__ = ["Decision", "Policy", "PolicyError"]
