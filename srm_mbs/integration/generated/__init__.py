"""Terms of one mechanism as C: recorded, compiled, cached and handed to the kernel."""
