"""What a step does around the renderer, each in one pass of compiled code with its gradient.

Float32 for work and float64 for tests take the same code. Tests compare it with the same formulas in torch.
"""
