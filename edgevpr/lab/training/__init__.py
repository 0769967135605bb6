"""Training from one's own pictures: the CALC autoencoder (`calc`), the words of VLAD and bag-of-words (`words`), and
networks in 8-bit integers (`quantise`).

All of it runs on a workstation, never in flight. PyTorch and onnx come with the extra `train`; only this package
imports them.
"""
