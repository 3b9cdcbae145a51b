"""Features and matching in torch and kornia, for GPUs; and the choice of the device.

The processor's own code (`features`, `matching`, `dense.patchmatch`) is the default without CUDA, where it is quicker.
"""
