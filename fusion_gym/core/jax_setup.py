"""JAX in 64 bits, with a persistent cache of its programs.

The cache's folder is JAX's ``jax_compilation_cache_dir``, by default ``~/.cache/fusion-gym/jax``.
"""

from fusion_gym.core import code_cache
from fusion_gym.importing import require

require("an environment under JAX", "jax", "jax")
import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)  # threads cost more than a step
_chosen = getattr(jax.config, "jax_compilation_cache_dir", None)
if _chosen is None and (folder := code_cache.folder_of("jax")):
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
