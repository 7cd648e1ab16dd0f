"""Settings that experiments and benchmarks share at a scale."""

#: TOML of fits at smoke scale: the smallest networks, few samples.
SMOKE = """
pixels = 64
spp = 4
preview_seconds = 600.0
[albedo]
width = 8
hidden = 1
[albedo.grid]
levels = 2
table_log2 = 8
[roughness]
width = 8
hidden = 1
[roughness.grid]
levels = 2
table_log2 = 8
[radiance]
width = 8
hidden = 1
[radiance.grid]
levels = 2
table_log2 = 8
"""
