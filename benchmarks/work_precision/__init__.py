"""Work-precision benchmark: run time against error, beside other simulators.

    python -m benchmarks.work_precision --out DIR [--problems ...] [--peers ...] [--sections ...]

``problems`` holds one module per problem, ``peers`` one per peer.  A run measures everything into
DIR/results.json; plots and tables are made from that file alone.  Peers that are not installed are
skipped with a message.
"""
