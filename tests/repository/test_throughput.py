"""The measurement of the pure functions on a GPU, tried on the device that JAX has."""

import pytest

jax = pytest.importorskip("jax")
throughput = pytest.importorskip("benchmarks.throughput")


def test_without_a_gpu_the_gpu_column_is_refused_and_the_page_stays() -> None:
    if jax.devices()[0].platform != "cpu":
        pytest.skip("here is a GPU")
    before = throughput.PAGE.read_text(encoding="utf-8")
    with pytest.raises(SystemExit, match="--gpu is not allowed: JAX has the platform 'cpu'"):
        throughput.main(gpu=True, page=True)
    assert throughput.PAGE.read_text(encoding="utf-8") == before


@pytest.mark.slow
def test_the_table_of_a_device_has_its_name_and_every_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(throughput, "GPU", (("RemoteEstimation-v1", {}),))
    text = throughput.measure_gpu(1e-3, (2, 64))
    _, _, row, _, last = text.split("\n")
    few, many, first = (float(cell.replace(",", "")) for cell in row.split("|")[2:5])
    assert 0 < few < many
    assert first > 0
    assert jax.devices()[0].device_kind in last
