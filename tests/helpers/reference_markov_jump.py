"""The Markov jump example in plain loops: the dense joint recursion and one run's estimates.

It follows the recursion of local and centre errors literally: one covariance of all errors, those
of the nodes and of the centre's copies, moved by dense matrices, noises stacked. Nothing of the
library is used.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

T = 0.5
PAPER: dict[str, Any] = {
    "transitions": np.array([[[0.8, 0.2 * T], [0.0, 0.6]], [[1.0, T], [0.0, T]]]),
    "gains": np.array([[[1.5], [0.6]], [[0.5 * T * T], [T]]]),
    "noise": np.array([[0.64]]),
    "chain": np.array([[0.65, 0.35], [0.35, 0.65]]),
    "pi": np.array([0.5, 0.5]),
    "mean": np.zeros(2),
    "start": 0.1 * np.eye(2),
    "matrices": np.array(
        [[[1.0, 1.0], [0.4, 1.0]], [[1.0, 0.6], [1.0, 0.2]], [[0.5, 1.0], [2.0, 0.5]]]
    ),
    "periods": [1, 2, 3],
    "values": np.array([[0.25, 0.5, 1.0], [0.2, 0.4, 0.8], [0.3, 0.6, 0.9]]),
    "shares": np.array([[0.2, 0.4, 0.4], [0.45, 0.35, 0.2], [0.7, 0.1, 0.2]]),
    "coupling": np.array([[0.2], [0.4], [0.3]]),
    "variance": np.array([0.49, 0.36, 0.9]),
}


class Dense:
    """The joint covariance at k|k-1, for one run; :meth:`send` closes a step."""

    def __init__(self, model: dict[str, Any]) -> None:
        self.model, self.time = model, 0
        phi, chain = model["transitions"], model["chain"]
        self.modes, self.n = len(phi), phi.shape[1]
        self.sensors, self.a = len(model["matrices"]), self.modes * self.n
        self.abar = np.zeros((self.a, self.a))
        for m in range(self.modes):
            for k in range(self.modes):
                rows = slice(m * self.n, (m + 1) * self.n)
                columns = slice(k * self.n, (k + 1) * self.n)
                self.abar[rows, columns] = chain[k, m] * phi[k]
        self.pi = model["pi"].copy()
        second = model["start"] + np.outer(model["mean"], model["mean"])
        self.moments = [self.pi[m] * second for m in range(self.modes)]
        self.mean = np.concatenate([self.pi[m] * model["mean"] for m in range(self.modes)])
        prior = self.moment() - np.outer(self.mean, self.mean)
        self.joint = np.kron(np.ones((2 * self.sensors, 2 * self.sensors)), prior)
        self.fading = [float(v @ s) for v, s in zip(model["values"], model["shares"], strict=True)]
        self.fading_variance = [
            float((v - b) ** 2 @ s)
            for v, s, b in zip(model["values"], model["shares"], self.fading, strict=True)
        ]
        self.measure()

    def moment(self) -> Array:
        result = np.zeros((self.a, self.a))
        for m in range(self.modes):
            result[m * self.n : (m + 1) * self.n, m * self.n : (m + 1) * self.n] = self.moments[m]
        return result

    def input(self) -> Array:
        model = self.model
        return np.vstack(
            [
                sum(
                    model["chain"][k, m] * self.pi[k] * model["gains"][k] for k in range(self.modes)
                )
                for m in range(self.modes)
            ]
        )

    def block(self, i: int) -> slice:
        return slice(i * self.a, (i + 1) * self.a)

    def measure(self) -> None:
        """Gains and noise covariances of this time."""
        model, count, r = self.model, self.sensors, self.model["noise"].shape[0]
        q = model["noise"]
        self.bbar, self.c, self.gain, self.noise_gain = self.input(), [], [], []
        self.sampled = [self.time > 0 and self.time % n == 0 for n in model["periods"]]
        self.q = []
        cov = np.zeros((r + count + self.a, r + count + self.a))
        cov[:r, :r] = q
        for i in range(count):
            alpha = model["coupling"][i : i + 1]
            cov[:r, r + i] = (q @ alpha.T)[:, 0]
            cov[r + i, :r] = cov[:r, r + i]
            for j in range(count):
                cov[r + i, r + j] = (alpha @ q @ model["coupling"][j : j + 1].T)[0, 0]
            unfaded = np.concatenate(list(model["matrices"][i]))
            cov[r + i, r + i] += (
                self.fading_variance[i] * unfaded @ self.moment() @ unfaded + model["variance"][i]
            )
            c = self.fading[i] * unfaded
            own = self.joint[self.block(i), self.block(i)]
            variance = float(c @ own @ c + cov[r + i, r + i])
            on = 1.0 if self.sampled[i] else 0.0
            self.c.append(c)
            self.q.append(variance)
            self.gain.append(on * own @ c / variance)
            self.noise_gain.append(on * (q @ alpha.T)[:, 0] / variance)
        self.noise_covariance = cov

    def filtered(self, sent: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Matrices from (errors, noises) to the errors after update and transmission."""
        count, a, r = self.sensors, self.a, self.model["noise"].shape[0]
        state, noise = (
            np.zeros((2 * count * a, 2 * count * a)),
            np.zeros((2 * count * a, r + count + a)),
        )
        for i in range(count):
            node, copy = self.block(i), self.block(count + i)
            state[node, node] = np.eye(a) - np.outer(self.gain[i], self.c[i])
            noise[node, r + i] = -self.gain[i]
            if sent[i]:
                state[copy, node], noise[copy] = state[node, node], noise[node]
            else:
                state[copy, copy] = np.eye(a)
        return state, noise

    def after(self, sent: NDArray[np.bool_]) -> Array:
        """Covariance of all errors after ``sent``, (2·sensors·a, 2·sensors·a)."""
        state, noise = self.filtered(sent)
        result: Array = state @ self.joint @ state.T + noise @ self.noise_covariance @ noise.T
        return result

    def copies(self, sent: NDArray[np.bool_]) -> Array:
        """Joint covariance of the centre's copies in the plant's states, (sensors·n, sensors·n)."""
        count = self.sensors
        sum_modes = np.kron(np.eye(count), np.kron(np.ones(self.modes), np.eye(self.n)))
        full = self.after(sent)[count * self.a :, count * self.a :]
        result: Array = sum_modes @ full @ sum_modes.T
        return result

    def send(self, sent: NDArray[np.bool_]) -> None:
        """The packets go out, time moves on."""
        model, count, a, r = self.model, self.sensors, self.a, self.model["noise"].shape[0]
        state, noise = self.filtered(sent)
        moved, driven = np.kron(np.eye(2 * count), self.abar) @ state, np.zeros_like(noise)
        driven += np.kron(np.eye(2 * count), self.abar) @ noise
        for i in range(count):
            for row, part in ((self.block(i), 1.0), (self.block(count + i), float(sent[i]))):
                driven[row, :r] += self.bbar
                driven[row, r + count :] += np.eye(a)
                back = self.bbar @ self.noise_gain[i]
                driven[row, r + i] -= part * back
                moved[row, self.block(i)] -= part * np.outer(back, self.c[i])
        now, cov = self.moment(), self.noise_covariance
        before = self.abar @ now @ self.abar.T + self.bbar @ model["noise"] @ self.bbar.T
        following = []
        for m in range(self.modes):
            total = np.zeros((self.n, self.n))
            for k in range(self.modes):
                phi, gamma = model["transitions"][k], model["gains"][k]
                part = phi @ self.moments[k] @ phi.T
                part = part + self.pi[k] * gamma @ model["noise"] @ gamma.T
                total += model["chain"][k, m] * part
            following.append(total)
        self.moments, self.pi = following, self.pi @ model["chain"]
        cov[r + count :, r + count :] = self.moment() - before
        joint = moved @ self.joint @ moved.T + driven @ cov @ driven.T
        self.joint, self.time = (joint + joint.T) / 2, self.time + 1
        self.mean = self.abar @ self.mean
        self.measure()


def best_weights(sigma: Array, n: int) -> tuple[Array, Array]:
    """Matrix weights and fused covariance by pseudo-inverses, as the paper's (56) with T."""
    e = np.kron(np.ones((len(sigma) // n, 1)), np.eye(n))
    inverse = np.linalg.pinv(sigma + e @ e.T, rcond=1e-13, hermitian=True)
    weights = np.linalg.pinv(e.T @ inverse @ e) @ e.T @ inverse
    return weights, weights @ sigma @ weights.T


class Run:
    """One run in plain loops, fed with the same standard normals as the library.

    Order of the normals at the start: the state, the mode, the process noise; at a step: the
    process noise, the mode, the fadings, the sensors' noises.
    """

    def __init__(self, model: dict[str, Any], normals: Array) -> None:
        self.model, self.dense = model, Dense(model)
        n, count = self.dense.n, self.dense.sensors
        self.x = model["mean"] + root(model["start"]) @ normals[:n]
        self.mode = place(model["pi"], normals[n])
        self.w = root(model["noise"]) @ normals[n + 1 :]
        self.node = [self.dense.mean.copy() for _ in range(count)]
        self.copy = [self.dense.mean.copy() for _ in range(count)]
        self.node_noise = [np.zeros(len(self.w)) for _ in range(count)]
        self.copy_noise = [np.zeros(len(self.w)) for _ in range(count)]
        self.sent = np.ones(count, dtype=bool)

    def sense(self, normals: Array) -> None:
        """To the next time: the plant, the sensors, the nodes."""
        model, count, r = self.model, self.dense.sensors, len(self.w)
        bbar = self.dense.bbar
        self.dense.send(self.sent)
        self.x = model["transitions"][self.mode] @ self.x + model["gains"][self.mode] @ self.w
        self.mode = place(model["chain"][self.mode], normals[r])
        self.w = root(model["noise"]) @ normals[:r]
        for i in range(count):
            self.node[i] = self.dense.abar @ self.node[i] + bbar @ self.node_noise[i]
            self.copy[i] = self.dense.abar @ self.copy[i] + bbar @ self.copy_noise[i]
            self.node_noise[i] = np.zeros(r)
            self.copy_noise[i] = np.zeros(r)
            if self.dense.sampled[i]:
                fading = model["values"][i][place(model["shares"][i], normals[r + 1 + i])]
                y = fading * model["matrices"][i][self.mode] @ self.x
                y += model["coupling"][i] @ self.w
                y += model["variance"][i] ** 0.5 * normals[r + 1 + count + i]
                innovation = y - self.dense.c[i] @ self.node[i]
                self.node[i] = self.node[i] + self.dense.gain[i] * innovation
                self.node_noise[i] = self.dense.noise_gain[i] * innovation

    def deliver(self, sent: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Fused mean and covariance after these packets."""
        self.sent, n = sent, self.dense.n
        for i in np.flatnonzero(sent):
            self.copy[i], self.copy_noise[i] = self.node[i].copy(), self.node_noise[i].copy()
        weights, covariance = best_weights(self.dense.copies(sent), n)
        states = [c.reshape(-1, n).sum(0) for c in self.copy]
        return weights @ np.concatenate(states), covariance


def root(matrix: Array) -> Array:
    """The pivoted Cholesky factor of the correlations, scaled, as the library draws with it."""
    scale = np.sqrt(np.diag(matrix))
    left, columns = matrix / np.outer(scale, scale), []
    np.fill_diagonal(left, 1.0)
    for _ in scale:
        pivot = int(np.argmax(np.diag(left)))
        columns.append(left[:, pivot] / np.sqrt(left[pivot, pivot]))
        left = left - np.outer(columns[-1], columns[-1])
    result: Array = scale[:, None] * np.stack(columns, axis=1)
    return result


def place(shares: Array, normal: float) -> int:
    """Index drawn from probabilities by a standard normal."""
    uniform, total = 0.5 * (1.0 + math.erf(normal / math.sqrt(2.0))), 0.0
    for index, share in enumerate(shares[:-1]):
        total += share
        if uniform <= total:
            return index
    return len(shares) - 1


def random_model(seed: int, modes: int = 3, n: int = 2, r: int = 2, sensors: int = 4) -> Any:
    """A mean-square stable model with everything drawn: asymmetric chain, means that are not 0."""
    draw = np.random.default_rng(seed)
    chain = draw.dirichlet(np.ones(modes), modes)
    phi = draw.normal(size=(modes, n, n))
    squares = [np.kron(p, p) for p in phi]
    operator = np.block([[chain[k, m] * squares[k] for k in range(modes)] for m in range(modes)])
    phi *= np.sqrt(0.7 / np.abs(np.linalg.eigvals(operator)).max())
    noise, start = draw.normal(size=(r, r)), draw.normal(size=(n, n))
    return {
        "transitions": phi,
        "gains": draw.normal(size=(modes, n, r)),
        "noise": noise @ noise.T + 0.1 * np.eye(r),
        "chain": chain,
        "pi": draw.dirichlet(np.ones(modes)),
        "mean": draw.normal(size=n),
        "start": start @ start.T + 0.1 * np.eye(n),
        "matrices": draw.normal(size=(sensors, modes, n)),
        "periods": draw.integers(1, 5, sensors).tolist(),
        "values": draw.uniform(size=(sensors, 3)),
        "shares": draw.dirichlet(np.ones(3), sensors),
        "coupling": 0.5 * draw.normal(size=(sensors, r)),
        "variance": draw.uniform(0.2, 1.0, sensors),
    }


def options(model: dict[str, Any]) -> dict[str, Any]:
    """The environment's options for a model."""
    return {
        "transitions": model["transitions"],
        "process_gains": model["gains"],
        "process_covariance": model["noise"],
        "mode_transition": model["chain"],
        "initial_probabilities": model["pi"],
        "initial_mean": model["mean"],
        "initial_covariance": model["start"],
        "measurement_matrices": model["matrices"],
        "sampling_periods": model["periods"],
        "fading_values": model["values"],
        "fading_probabilities": model["shares"],
        "noise_coupling": model["coupling"],
        "measurement_variance": model["variance"],
    }
