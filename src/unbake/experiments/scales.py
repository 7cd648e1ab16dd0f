"""Settings that experiments and benchmarks share at a scale."""

#: TOML of fits at smoke scale: the smallest networks, few samples.
SMOKE = """
pixels = 64
spp = 4
preview_seconds = 600.0
[materials.albedo.neural]
width = 8
hidden = 1
grid = { levels = 2, table_log2 = 8 }
[materials.roughness.neural]
width = 8
hidden = 1
grid = { levels = 2, table_log2 = 8 }
[radiance.neural]
width = 8
hidden = 1
grid = { levels = 2, table_log2 = 8 }
"""
