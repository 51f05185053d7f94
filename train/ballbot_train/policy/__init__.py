"""What a trained policy is: its network, its file, and the same in ONNX and C."""
