"""Who does the work: processes of this machine, or a cluster that is there already.

joblib hands it out, through its own processes (``loky``) or a dask scheduler; a ray cluster does it
as ray's tasks, for joblib's backend of it gives nothing back before all is done. On other machines
every path must be the same: the folders of results and work are shared.
"""

import contextlib
import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import joblib

from fusion_gym.validation import ConfigurationError

BackendName = Literal["loky", "dask", "ray"]
_PACKAGES = {"dask": "distributed", "ray": "ray"}
_PATIENCE = 30.0  # seconds until a scheduler that does not answer is given up


@dataclass(frozen=True)
class Team:
    """``workers`` processes here, or all those of the cluster at ``address``.

    With ``dask`` or ``ray`` and without an address a cluster of so many workers is begun here.

    Raises:
        ConfigurationError: an address where there is no cluster.
    """

    workers: int = 2
    backend: BackendName = "loky"
    address: str | None = None

    def __post_init__(self) -> None:
        if self.address is not None and self.backend == "loky":
            raise ConfigurationError(
                f"address = {self.address!r} is not allowed with backend='loky', which has none: "
                "it belongs to 'dask' and 'ray'"
            )

    @property
    def here(self) -> bool:
        """Whether the workers are processes of this one."""
        return self.backend == "loky"

    def done(self, function: Callable[[Any], float], pieces: Sequence[Any]) -> Iterator[float]:
        """Let the team do the pieces; what the function returns, as it comes. While gathered."""
        if self.backend == "ray":
            yield from self._done_by_ray(function, pieces)
        else:
            calls = (joblib.delayed(function)(piece) for piece in pieces)
            yield from joblib.Parallel(return_as="generator_unordered", batch_size=1)(calls)

    def _done_by_ray(
        self, function: Callable[[Any], float], pieces: Sequence[Any]
    ) -> Iterator[float]:
        ray = self._package()
        task = ray.remote(num_cpus=1, max_retries=-1)(lambda piece: function(piece))
        left = [task.remote(piece) for piece in pieces]
        while left:
            ended, left = ray.wait(left)
            try:
                yield from ray.get(ended)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from None

    @contextlib.contextmanager
    def gathered(self) -> Iterator[None]:
        """Work goes to the team while this is entered.

        Raises:
            ConfigurationError: the backend's package is not installed, or nobody is at the address.
        """
        with contextlib.ExitStack() as stack:
            if self.backend == "dask":
                stack.enter_context(self._dask())
            if self.backend == "ray":
                stack.enter_context(self._ray())
            else:
                jobs = self.workers if self.here else -1
                stack.enter_context(joblib.parallel_config(self.backend, n_jobs=jobs))
            yield

    @contextlib.contextmanager
    def _dask(self) -> Iterator[None]:
        distributed = self._package()
        try:
            if self.address is None:
                client = distributed.Client(n_workers=self.workers, threads_per_worker=1)
            else:
                client = distributed.Client(self.address, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            raise self._nobody(error) from None
        with client:
            yield

    @contextlib.contextmanager
    def _ray(self) -> Iterator[None]:
        ray = self._package()
        try:
            if self.address is None:
                ray.init(num_cpus=self.workers, include_dashboard=False)
            else:
                ray.init(address=self.address)
        except (OSError, ValueError) as error:
            raise self._nobody(error) from None
        try:
            yield
        finally:
            ray.shutdown()

    def _package(self) -> Any:
        name = _PACKAGES[self.backend]
        try:
            return importlib.import_module(name)
        except ImportError:
            raise ConfigurationError(
                f"backend = {self.backend!r} is not allowed: it needs {name}, which "
                f"'fusion-gym[{self.backend}]' installs"
            ) from None

    def _nobody(self, error: Exception) -> ConfigurationError:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        return ConfigurationError(
            f"address = {self.address!r} is not allowed with backend={self.backend!r}: {reason}"
        )
