# SPDX-License-Identifier: Apache-2.0
"""The particles of the group stochastic M-algorithm, in strata of a Markov chain.

Based on Zheng et al. 2015, section 3.5 and eqs. (14)-(22), with these corrections:

* The group of a particle is {f - h, f, f + h} around its own value with prior weights 1/6, 2/3, 1/6 and
  h = sqrt(3 q dt): every value has its group (the paper omits one), values are not bound to a grid, and the
  transition has the variance of a random walk per second instead of a grid step per sample.
* Weights are retained: w_k = w_{k-1} p(f_k | f_{k-1}) N(y_k); pruning is systematic resampling in the order of f.
* Particles belong to strata with different q (quiet, jumping); a Markov chain transfers weight between the strata.
  Each stratum keeps its number of particles however small its weight, so an improbable hypothesis is not pruned
  before the measurements can decide.
* Before branching, a stratum shrinks by sqrt(1 - kappa^2) towards its mean and h grows to
  sqrt(3 (q dt + kappa^2 s^2)), which preserves its mean and its variance s^2 + q dt and keeps its values distinct. x
  moves with f according to its regression on f. After pruning, the particles are shifted and scaled to the mean and
  variance before pruning. In a stratum with a Gaussian posterior no sampling noise is left in either.

Between two prunings all particles move by the same linear map, x = A [1, f, x0] with the states x0 of the last pruning.
So a step without pruning changes A, and of the particles only their speeds, whose spread is needed.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from trainid_ros.brake_rate.posterior import ERRORS, STATES
from trainid_ros.vectors import i64, vec

if TYPE_CHECKING:
    from trainid_ros.brake_rate.posterior import Start, Transition

# Logarithms of the prior weights of the children in a group: outer and middle.
_LOG_OUTER: Final = math.log(1.0 / 6.0)
_LOG_MIDDLE: Final = math.log(4.0 / 6.0)
_KAPPA: Final = 0.2
_SHRUNK: Final = math.sqrt(1.0 - 0.2 * 0.2) - 1.0
# Limit of the factor that scales survivors to the variance before pruning.
_MOST_SPREAD: Final = 2.0
_TINY: Final = 1e-300
# Lower limit of the variance: if one child has all the weight, the spread within its group is still unknown.
_LEAST_VARIANCE: Final = 1e-10
WIDTH: Final = 13
"""Number of columns of A, those of 1, f and x0."""
# Rows of x.
_V: Final = 0
_A: Final = 1
_E: Final = 3


def zeros(count: int) -> vec[float]:
    """Return an array of zeros, shape (count,)."""
    return vec[float]([0.0] * count)


class GroupCloud:
    """Particles with rates f and states x = [v, a, b, e]; the weights within a stratum are equal.

    Matrices are stored row by row. Particles of one stratum follow one another, in the order of f.

    Attributes:
        N: Number of particles.
        M: Number of strata.
        edges: Index of the first particle of each stratum, and N; shape (M + 1,).
        stratum: Stratum of each child, and so of each particle, shape (3 N,).
        f: Brake rate of each particle [1], shape (N,).
        x: States x0 of the particles at the last pruning, shape (n, N).
        A: What has moved them since, shape (n, 2 + n).
        x_mean: Mean of x0 over all particles, shape (n,).
        weight: Weight of each stratum, shape (M,), with the sum one.
        mean: Mean of f in each stratum [1], shape (M,).
        variance: Variance of f in each stratum [1], shape (M,).
        slope: Regression of x0 on f in each stratum, shape (n, M).
        rate: Mean of f [1], eq. (19).
        rate_variance: Variance of f [1].

    """

    def __init__(self, sizes: list[int]) -> None:
        N, M, n = sum(sizes), len(sizes), STATES
        self.N: i64 = N
        self.M: i64 = M
        self.edges = vec[i64]([sum(sizes[:m]) for m in range(M + 1)])
        self.stratum = vec[i64]([m for _ in range(3) for m, size in enumerate(sizes) for _ in range(size)])
        self.f, self.x, self.A, self.x_mean = zeros(N), zeros(n * N), zeros(n * WIDTH), zeros(n)
        self.weight, self.mean, self.variance, self.slope = zeros(M), zeros(M), zeros(M), zeros(n * M)
        self.rate = self.rate_variance = 0.0
        # Speeds, and the next rates and states.
        self._v, self._next_f, self._next = zeros(N), zeros(N), zeros(n * N)
        # Of each particle: f shrunk, how far it moved, innovation, weight of its group, weight times f, a state.
        self._base, self._moved, self._nu, self._w0, self._wf = zeros(N), zeros(N), zeros(N), zeros(N), zeros(N)
        self._row = zeros(N)
        # Of each child: rate, weight, place in the order of f. Child g of particle i has the number g N + i.
        self._rates, self._w = zeros(3 * N), zeros(3 * N)
        self._order, self._merged = vec[i64]([0] * (3 * N)), vec[i64]([0] * (3 * N))
        self._runs = vec[i64]([0] * (3 * N + 1))
        # Of each survivor: its particle, its distance from it, and its shift to the moments before pruning.
        self._parent, self._off, self._shift = vec[i64]([0] * N), zeros(N), zeros(N)
        # Of each stratum: step, and slopes of the predicted states over f and within the groups, shape (n, M).
        self._h, self._slopes, self._c, self._c_v = zeros(M), zeros(n * M), zeros(n * M), zeros(M)
        # Sums over its children of w, w f, w f^2, w off, w f off, w x and w x f.
        self._ones, self._firsts, self._squares, self._offs, self._products = (zeros(M) for _ in range(5))
        self._states, self._state_products, self._share = zeros(M), zeros(M), zeros(M)
        self._next_weight, self._next_mean, self._next_variance = zeros(M), zeros(M), zeros(M)
        self._stand_still()

    def start(self, f: list[float], weight: list[float]) -> None:
        """Start at rest from rates f [1], shape (N,), with the weights of the strata, shape (M,)."""
        for i in range(self.N):
            self.f[i] = f[int(i)]
        for k in range(STATES * self.N):
            self.x[k] = 0.0
        for j in range(STATES):
            self.x_mean[j] = 0.0
        for m in range(self.M):
            total = square = 0.0
            size = float(self.edges[m + 1] - self.edges[m])
            for i in range(self.edges[m], self.edges[m + 1]):
                total += self.f[i] / size
            for i in range(self.edges[m], self.edges[m + 1]):
                off = self.f[i] - total
                square += off * off / size
            self.weight[m], self.mean[m], self.variance[m] = weight[int(m)], total, square
            for j in range(STATES):
                self.slope[j * self.M + m] = 0.0
        self._stand_still()
        self.average()

    def _stand_still(self) -> None:
        """Set A to the identity, x = x0."""
        for k in range(STATES * WIDTH):
            self.A[k] = 0.0
        for j in range(STATES):
            self.A[j * WIDTH + 2 + j] = 1.0

    def average(self) -> None:
        """Set mean and variance of f from those of the strata."""
        rate = spread = 0.0
        for m in range(self.M):
            rate += self.weight[m] * self.mean[m]
        for m in range(self.M):
            off = self.mean[m] - rate
            spread += self.weight[m] * (self.variance[m] + off * off)
        self.rate, self.rate_variance = rate, spread

    # Motion of all particles alike.

    def anchor(self, start: Start) -> None:
        """Restart v, a = f target and b; the errors decay by ``decay_e``."""
        A = self.A
        for k in range(_E * WIDTH):
            A[k] = 0.0
        A[_V * WIDTH], A[_A * WIDTH + 1] = start.speed, start.target
        for j in range(ERRORS):
            decay_e = start.decay_e[j]
            for k in range(WIDTH):
                A[(_E + j) * WIDTH + k] *= decay_e

    def recentre(self, shift: vec[float]) -> None:
        """Express the errors relative to a new origin, ``shift`` away from the old, shape (8,)."""
        for j in range(ERRORS):
            self.A[(_E + j) * WIDTH] -= shift[j]

    def predict(self, step: Transition) -> None:
        """Predict over an interval with constant f, eq. (14)."""
        A, a, b = self.A, WIDTH, 2 * WIDTH
        gain_e, decay_e = step.gain_e, step.decay_e
        for k in range(WIDTH):
            v = A[k] + step.reach * A[a + k] + step.dt * A[b + k]
            for j in range(ERRORS):
                v += gain_e[j] * A[(_E + j) * WIDTH + k]
                A[(_E + j) * WIDTH + k] *= decay_e[j]
            A[k], A[a + k], A[b + k] = v, step.decay * A[a + k], step.rho * A[b + k]
        A[0] += step.known
        A[1] += step.gain_v
        A[a + 1] += step.gain_a
        self._each(A, 0, self._v, 0)

    def follow(self, speed: float, K: vec[float]) -> None:
        """Update x with a measured speed that carries no information on f, by the gain K, shape (n,), eq. (21)."""
        A = self.A
        for k in range(WIDTH):
            nu = (speed if k == 0 else 0.0) - A[k]
            for j in range(STATES):
                A[j * WIDTH + k] += K[j] * nu

    def _each(self, row: vec[float], at: i64, out: vec[float], to: i64) -> None:
        """Write row [1, f, x0] of each particle; the row begins at ``at``, the output, shape (N,), at ``to``."""
        f, x, N = self.f, self.x, self.N
        known, gain = row[at], row[at + 1]
        for i in range(N):
            out[to + i] = known + gain * f[i]
        for j in range(STATES):
            share = row[at + 2 + j]
            if share != 0.0:
                for i in range(N):
                    out[to + i] += share * x[j * N + i]

    def _is_mixed(self) -> bool:
        """Whether A mixes other states than v, as an update with a measured speed does."""
        for j in range(1, STATES):
            for k in range(STATES):
                if k != j and self.A[j * WIDTH + 2 + k] != 0.0:
                    return True
        return False

    def _settle(self) -> None:
        """Move the particles by A, which then is the identity."""
        M = self.M
        means, slopes = zeros(STATES), zeros(int(STATES * M))
        for j in range(STATES):
            self._each(self.A, j * WIDTH, self._next, j * self.N)
            means[j] = self.expected(j)
            for m in range(M):
                slopes[j * M + m] = self._slope(j, m)
        self.x, self._next, self.x_mean, self.slope = self._next, self.x, means, slopes
        self._stand_still()

    def _slope(self, j: i64, m: i64) -> float:
        """Return the regression of the j-th state on f in a stratum."""
        slope = self.A[j * WIDTH + 1]
        for k in range(STATES):
            slope += self.A[j * WIDTH + 2 + k] * self.slope[k * self.M + m]
        return slope

    # Moments of the states.

    def expected(self, j: i64) -> float:
        """Return the mean of the j-th state."""
        return self._expected(self.A, j * WIDTH)

    def _expected(self, row: vec[float], at: i64) -> float:
        mean = row[at] + row[at + 1] * self.rate
        for k in range(STATES):
            mean += row[at + 2 + k] * self.x_mean[k]
        return mean

    def speed_spread(self) -> float:
        """Return the variance of the predicted speeds [(m/s)^2]."""
        return self._spread(self._v, self.expected(_V))

    def spread(self, j: i64) -> float:
        """Return the variance of the j-th state over the particles."""
        self._each(self.A, j * WIDTH, self._row, 0)
        return self._spread(self._row, self.expected(j))

    def total(self, share: vec[float]) -> tuple[float, float]:
        """Return mean and variance over the particles of f + share e [1]; share of shape (8,)."""
        row = zeros(WIDTH)
        row[1] = 1.0
        for j in range(ERRORS):
            if share[j] != 0.0:
                for k in range(WIDTH):
                    row[k] += share[j] * self.A[(_E + j) * WIDTH + k]
        mean = self._expected(row, 0)
        self._each(row, 0, self._row, 0)
        return mean, self._spread(self._row, mean)

    def _spread(self, values: vec[float], mean: float) -> float:
        """Return the variance of values of the particles, shape (N,)."""
        spread = 0.0
        for m in range(self.M):
            low, high = self.edges[m], self.edges[m + 1]
            squares = 0.0
            for i in range(low, high):
                off = values[i] - mean
                squares += off * off
            spread += self.weight[m] / float(high - low) * squares
        return spread

    # A step of GSMA.

    def widen(self, step: Transition, variance: float) -> None:
        """Add to the variance of f [1] the drift before the predicted step, by spreading the values."""
        total, rate, N, M = self.rate_variance, self.rate, self.N, self.M
        if total <= 0.0:
            return
        self._settle()
        ratio = math.sqrt(1.0 + variance / total)
        for i in range(N):
            wider = (ratio - 1.0) * (self.f[i] - rate)
            self.f[i] += wider
            self.x[_V * N + i] += step.gain_v * wider
            self.x[_A * N + i] += step.gain_a * wider
            self._v[i] = self.x[_V * N + i]
        for m in range(M):
            self.mean[m] = rate + ratio * (self.mean[m] - rate)
            self.variance[m] *= ratio * ratio
            self.slope[_V * M + m] += (ratio - 1.0) * step.gain_v
            self.slope[_A * M + m] += (ratio - 1.0) * step.gain_a
            for j in range(STATES):
                self.slope[j * M + m] /= ratio

    def learn(
        self,
        step: Transition,
        walk: vec[float],
        speed: float,
        K: vec[float],
        S: float,
        largest: float,
        chain: vec[float],
        uniforms: list[float],
    ) -> float:
        """Branch, weigh and prune predicted particles.

        Args:
            step: Motion model since the last sample.
            walk: Variance q dt of f [1] in each stratum, shape (M,).
            speed: Measured speed [m/s].
            K: Gain, eq. (20), shape (n,).
            S: Variance of the innovation, eq. (16) [(m/s)^2].
            largest: Largest rate [1]; children outside 0 <= f <= largest get the weight zero.
            chain: Transition probabilities from stratum (row) to stratum (column), shape (M, M).
            uniforms: A draw in [0, 1) for each stratum, shape (M,).

        Returns:
            The effective number of children [1].

        """
        if self._is_mixed():
            self._settle()
        self._branch(step, walk, speed)
        effective = self._weigh(1.0 / math.sqrt(S), largest)
        self._sum_rates(chain)
        self._sort()
        self._prune(chain, uniforms)
        for j in range(STATES):
            self._learn_state(j, K[j], chain)
        self.x, self._next, self.f, self._next_f = self._next, self.x, self._next_f, self.f
        self._stand_still()
        self._take_moments()
        return effective

    def _branch(self, step: Transition, walk: vec[float], speed: float) -> None:
        """Shrink the strata; set step and slopes within their groups, and the innovations of the middle children."""
        f, v, base, moved, nu, M = self.f, self._v, self._base, self._moved, self._nu, self.M
        for m in range(M):
            kernel = _KAPPA * _KAPPA * self.variance[m]
            both = max(walk[m] + kernel, _TINY)
            self._h[m] = math.sqrt(3.0 * both)
            # The kernel moves f over its entire past, so x along its regression; the walk moves f in this step only.
            for j in range(STATES):
                gain = step.gain_v if j == _V else step.gain_a if j == _A else 0.0
                slope = self._slope(j, m)
                self._slopes[j * M + m] = slope
                self._c[j * M + m] = gain + kernel / both * (slope - gain)
            self._c_v[m] = self._c[_V * M + m]
            mean, slope = self.mean[m], self._slopes[_V * M + m]
            for i in range(self.edges[m], self.edges[m + 1]):
                off = _SHRUNK * (f[i] - mean)
                moved[i] = off
                base[i] = f[i] + off
                nu[i] = speed - (v[i] + slope * off)

    def _weigh(self, W: float, largest: float) -> float:
        """Set rates and normalised weights of the children, eqs. (17), (18); return their effective number [1].

        W is one over the standard deviation of the innovation [s/m].
        """
        base, nu, rates, w, N = self._base, self._nu, self._rates, self._w, self.N
        peak = -math.inf
        for m in range(self.M):
            low, high = self.edges[m], self.edges[m + 1]
            prior = math.log(max(self.weight[m], _TINY) / float(high - low))
            for g in range(3):
                off, log_prior = float(g - 1) * self._h[m], prior + (_LOG_MIDDLE if g == 1 else _LOG_OUTER)
                ahead, child = off * self._c[_V * self.M + m], g * N
                for i in range(low, high):
                    rate, z = base[i] + off, W * (nu[i] - ahead)
                    log_weight = log_prior - 0.5 * (z * z) if 0.0 <= rate <= largest else -math.inf
                    rates[child + i], w[child + i] = rate, log_weight
                    peak = max(peak, log_weight)
        total = squares = 0.0
        for k in range(3 * N):
            # Equal weights if all children are impossible.
            weight = math.exp(w[k] - peak) if peak > -math.inf else 1.0
            w[k] = weight
            total += weight
            squares += weight * weight
        for k in range(3 * N):
            w[k] /= total
        return total * total / squares

    def _sum_rates(self, chain: vec[float]) -> None:
        """Set the sums over the children of each stratum, and the moments of f that each stratum will have.

        f counts from its mean before, so that the moments are not differences of large numbers.
        """
        base, w, w0, wf, N, M, centre = self._base, self._w, self._w0, self._wf, self.N, self.M, self.rate
        for m in range(M):
            h = self._h[m]
            ones = firsts = squares = offs = products = 0.0
            for i in range(self.edges[m], self.edges[m + 1]):
                f, below, above = base[i] - centre, w[i], w[2 * N + i]
                one, off = below + w[N + i] + above, (above - below) * h
                first, product = f * one + off, f * off + (above + below) * h * h
                w0[i], wf[i] = one, first
                ones += one
                firsts += first
                squares += f * first + product
                offs += off
                products += product
            self._ones[m], self._firsts[m], self._squares[m] = ones, firsts, squares
            self._offs[m], self._products[m] = offs, products
        for m in range(M):
            weight = max(self._into(self._ones, chain, m), _TINY)
            mean = self._into(self._firsts, chain, m) / weight
            square = self._into(self._squares, chain, m) / weight
            self._next_weight[m], self._next_mean[m] = weight, mean
            self._next_variance[m] = max(square - mean * mean, _LEAST_VARIANCE)

    def _into(self, sums: vec[float], chain: vec[float], m: i64) -> float:
        """Return what the chain carries of sums over each stratum, shape (M,), into the m-th."""
        total = 0.0
        for source in range(self.M):
            total += sums[source] * chain[source * self.M + m]
        return total

    def _sort(self) -> None:
        """Put the children in the order of f, equal ones in that of their numbers, by merging runs in order.

        Survivors are in order, so there is a run for each child of the group in each stratum.
        """
        rates, order, merged, runs, count = self._rates, self._order, self._merged, self._runs, 3 * self.N
        last: i64 = 0
        for k in range(count):
            order[k] = k
            if k == 0 or rates[k] < rates[k - 1]:
                runs[last] = k
                last += 1
        runs[last] = count
        while last > 1:
            pair: i64 = 0
            while pair < last:
                low, middle = runs[pair], runs[pair + 1]
                high = runs[pair + 2] if pair + 1 < last else middle
                i, j = low, middle
                for k in range(low, high):
                    if i < middle and (j >= high or rates[order[i]] <= rates[order[j]]):
                        merged[k] = order[i]
                        i += 1
                    else:
                        merged[k] = order[j]
                        j += 1
                runs[pair // 2] = low
                pair += 2
            last = (last + 1) // 2
            runs[last] = count
            order, merged = merged, order
        self._order, self._merged = order, merged

    def _prune(self, chain: vec[float], uniforms: list[float]) -> None:
        """Choose the survivors of each stratum by systematic resampling, and match the moments of f before it."""
        order, rates, w, of, share, N, M = self._order, self._rates, self._w, self.stratum, self._share, self.N, self.M
        parent, off, shift, f = self._parent, self._off, self._shift, self._next_f
        for m in range(M):
            low, high = self.edges[m], self.edges[m + 1]
            size, uniform = float(high - low), uniforms[int(m)]
            for source in range(M):
                share[source] = chain[source * M + m] / self._next_weight[m]
            place: i64 = 0
            child = order[0]
            total, average = w[child] * share[of[child]], 0.0
            for k in range(low, high):
                position = (float(k - low) + uniform) / size
                while total <= position and place < 3 * N - 1:
                    place += 1
                    child = order[place]
                    total += w[child] * share[of[child]]
                side = -1.0 if child < N else 0.0 if child < 2 * N else 1.0
                parent[k], off[k], f[k] = child % N, side * self._h[of[child]], rates[child]
                average += f[k]
            average /= size
            spread, mean = 0.0, self.rate + self._next_mean[m]
            for k in range(low, high):
                spread += (f[k] - average) * (f[k] - average)
            factor = min(math.sqrt(self._next_variance[m] / max(spread / size, _TINY)), _MOST_SPREAD)
            for k in range(low, high):
                matched = mean + factor * (f[k] - average)
                shift[k] = matched - f[k]
                f[k] = matched

    def _learn_state(self, j: i64, K: float, chain: vec[float]) -> None:
        """Update a state of all particles, eq. (21), and take over that of the survivors."""
        f, x, moved, nu, w0, wf, row = self.f, self.x, self._moved, self._nu, self._w0, self._wf, self._row
        N, M, at, after = self.N, self.M, j * self.N, self._next
        parent, off, shift, of, c = self._parent, self._off, self._shift, self.stratum, self._c
        # The speeds have been predicted; of another state only its own share and f are in A.
        known, gain, left = self.A[j * WIDTH], self.A[j * WIDTH + 1], self.A[j * WIDTH + 2 + j]
        if j == _V:
            x, at, known, gain, left = self._v, 0, 0.0, 0.0, 1.0
        for m in range(M):
            slope = self._slopes[j * M + m]
            c[j * M + m] -= K * self._c_v[m]
            states = products = 0.0
            for i in range(self.edges[m], self.edges[m + 1]):
                state = known + gain * f[i] + left * x[at + i] + slope * moved[i] + K * nu[i]
                row[i] = state
                states += state * w0[i]
                products += state * wf[i]
            self._states[m] = states + c[j * M + m] * self._offs[m]
            self._state_products[m] = products + c[j * M + m] * self._products[m]
        mean = 0.0
        for m in range(M):
            low, high, weight = self.edges[m], self.edges[m + 1], self._next_weight[m]
            within = self._into(self._states, chain, m) / weight
            product = self._into(self._state_products, chain, m) / weight
            slope = (product - within * self._next_mean[m]) / self._next_variance[m]
            self.slope[j * M + m] = slope
            total = 0.0
            for k in range(low, high):
                i = parent[k]
                state = row[i] + off[k] * c[j * M + of[i]] + slope * shift[k]
                after[j * N + k] = state
                total += state
            back = within - total / float(high - low)
            for k in range(low, high):
                after[j * N + k] += back
            mean += weight * within
        self.x_mean[j] = mean

    def _take_moments(self) -> None:
        """Take over the moments of the strata, and the means of the states."""
        total = 0.0
        for m in range(self.M):
            total += self._next_weight[m]
        for m in range(self.M):
            self.weight[m] = self._next_weight[m] / total
            self.mean[m] = self.rate + self._next_mean[m]
            self.variance[m] = self._next_variance[m]
        for j in range(STATES):
            self.x_mean[j] /= total
        self.average()
