"""Training on one's own pictures: the CALC autoencoder (`calc`) and the words of VLAD and bag-of-words (`words`).

It runs on a workstation, never in flight. PyTorch and onnx come with the extra `train` and are imported only here.
"""
