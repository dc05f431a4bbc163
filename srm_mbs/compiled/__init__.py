"""Runs on the compiled kernel: what goes into it, how it is driven, and what comes out.

The kernel has the split PSRM with its stages, zone, placement, guard and step-size control, and
dense output.  It gets every constant from the modules of the Python reference, hands back arrays,
and leaves what is rare to Python: events, progress, and the sentences that say why a run stopped.

``handover``
    Numbers of the algorithm, and what a run remembers, in the words of the kernel and back.
``twin``
    A mechanism in the kernel.
``run``
    A run in the kernel, advanced in chunks.
``driving``
    From the start of a run to its record: chunks, events, breakpoints, why it stopped.
``dense_output``
    Dense output.

Whether the kernel is used at all is decided in :mod:`srm_mbs.kernel`.
"""
