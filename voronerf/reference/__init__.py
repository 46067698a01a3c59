"""Every operation in plain PyTorch: the specification, on any device, in any floating type including float64.

One module for each operation, holding a function of the same name and the arguments of ``voronerf.ops`` without
``backend``. Arguments have been validated by the caller.
"""
