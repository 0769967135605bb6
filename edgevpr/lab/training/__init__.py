"""Training from one's own pictures: the CALC autoencoder, visual words, and networks in 8-bit integers (`quantise`).

It runs on a workstation, never in flight. PyTorch and onnx come with the extra `train` and are imported only here.
"""
