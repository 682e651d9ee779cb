"""How fast Tapetum is beside its peers, on the machine at hand: `python -m benchmarks [NAME…] [--write] [--quick]`.

Each benchmark runs ours and a peer in turns in one process, so that whatever else the machine does hits both; what
counts is the ratio. The peers are development dependencies only.
"""
