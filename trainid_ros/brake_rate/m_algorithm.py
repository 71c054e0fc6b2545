# SPDX-License-Identifier: Apache-2.0
"""The particles of GSMA: their motion and moments, and one step of the group stochastic M-algorithm.

The steps [n] are those at the head of :mod:`gsma`. Based on Zheng et al. 2015, section 3.5 and eqs. (14)-(22), with
these corrections:

* The group of a particle is {f - h, f, f + h} around its own value with prior weights 1/6, 2/3, 1/6 and
  h = sqrt(3 q dt), the variance of a random walk: every value has its group (the paper omits one), without a grid.
* Weights are retained: w_k = w_{k-1} p(f_k | f_{k-1}) N(y_k); pruning is systematic resampling in the order of f.
* Particles belong to strata with different q (quiet, jumping); a Markov chain transfers weight between the strata.
  Each keeps its number of particles however small its weight, so no improbable hypothesis is pruned too soon.
* Before branching, a stratum shrinks by sqrt(1 - kappa^2) towards its mean and h grows to
  sqrt(3 (q dt + kappa^2 s^2)), which preserves its mean and its variance s^2 + q dt and keeps its values distinct. x
  moves with f according to its regression on f. After pruning, the particles are shifted and scaled to the mean and
  variance before pruning. In a stratum with a Gaussian posterior no sampling noise is left in either.

Between two prunings all particles move by the same linear map, x = A [1, f, x0], with the states x0 at the last
pruning. So a step without pruning changes only A and the speeds.
"""

from __future__ import annotations

import math
from typing import ClassVar, Final

from trainid_ros.brake_rate.motion_model import ERRORS, STATES, Start, Transition
from trainid_ros.interface.state import State, declare
from trainid_ros.interface.vectors import i64, vec

WIDTH: Final = 2 + STATES  # number of columns of A, those of 1, f and x0
# Rows of v, a and e in x.
_V: Final = 0
_A: Final = 1
_E: Final = 3
# Logarithms of the prior weights of the children in a group: outer and middle.
_LOG_OUTER: Final = math.log(1.0 / 6.0)
_LOG_MIDDLE: Final = math.log(4.0 / 6.0)
# Width of the kernel in standard deviations of f [1], and the change of a value when its stratum shrinks for it.
_KAPPA: Final = 0.2
_SHRUNK: Final = math.sqrt(1.0 - _KAPPA * _KAPPA) - 1.0
# Limit of the factor that scales survivors to the variance before pruning.
_MAX_SPREAD_FACTOR: Final = 2.0
_TINY: Final = 1e-300
# Lower limit of the variance: if one child has all the weight, the spread within its group is still unknown.
_MIN_VARIANCE: Final = 1e-10


def zeros(count: int) -> vec[float]:
    """Return an array of zeros, shape (count,)."""
    return vec[float]([0.0] * count)


class GroupCloud:
    """Particles with rates f and states x = [v, a, b, e]; the weights within a stratum are equal.

    Matrices are stored row by row. Particles of a stratum follow one another, in the order of f.

    Attributes:
        N: Number of particles.
        M: Number of strata.
        edges: Index of the first particle of each stratum, and N; shape (M + 1,).
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
        v: Predicted speeds [m/s], shape (N,).
    """

    STATE: ClassVar[State] = declare(
        'f', 'x', 'A', 'x_mean', 'weight', 'mean', 'variance', 'slope', 'rate', 'rate_variance'
    )

    def __init__(self, sizes: list[int]) -> None:
        N, M, n = sum(sizes), len(sizes), STATES
        self.N: i64 = N
        self.M: i64 = M
        self.edges = vec[i64]([sum(sizes[:m]) for m in range(M + 1)])
        self.f, self.x, self.A, self.x_mean = zeros(N), zeros(n * N), zeros(n * WIDTH), zeros(n)
        self.weight, self.mean, self.variance, self.slope = zeros(M), zeros(M), zeros(M), zeros(n * M)
        self.rate = self.rate_variance = 0.0
        self.v = zeros(N)
        # The next states, and one row of them.
        self._next, self._row = zeros(n * N), zeros(N)
        # What a step of the M-algorithm sets. Stratum of each child, and so of each particle.
        self._of = vec[i64]([m for _ in range(3) for m, size in enumerate(sizes) for _ in range(size)])
        self._next_f = zeros(N)
        # Of each particle: f shrunk, how far it moved, innovation, weight of its group, weight times f.
        self._base, self._moved, self._nu, self._w0, self._wf = zeros(N), zeros(N), zeros(N), zeros(N), zeros(N)
        # Of each child: rate, weight, place in the order of f. Child g of particle i has the number g N + i.
        self._rates, self._w = zeros(3 * N), zeros(3 * N)
        self._order, self._merged = vec[i64]([0] * (3 * N)), vec[i64]([0] * (3 * N))
        self._runs = vec[i64]([0] * (3 * N + 1))
        # Of each survivor: its particle, its distance from it, and its shift to the moments before pruning.
        self._parent, self._off, self._shift = vec[i64]([0] * N), zeros(N), zeros(N)
        # Of each stratum: step, and slopes of the predicted states over f and within the groups, shape (n, M).
        self._h, self._slopes, self._c, self._c_v = zeros(M), zeros(n * M), zeros(n * M), zeros(M)
        # Sums over its children of w, w f, w f^2, w off, w f off, w x and w x f.
        self._sum_w, self._sum_wf, self._sum_wff, self._sum_woff, self._sum_wfoff = (zeros(M) for _ in range(5))
        self._sum_wx, self._sum_wxf, self._share = zeros(M), zeros(M), zeros(M)
        self._next_weight, self._next_mean, self._next_variance = zeros(M), zeros(M), zeros(M)
        self._reset_transform()

    def start(self, f: list[float], weight: list[float]) -> None:
        """Start at rest from rates f [1] and the weights of the strata."""
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
        self._reset_transform()
        self._average()

    def _reset_transform(self) -> None:
        """Set A to the identity, x = x0."""
        for k in range(STATES * WIDTH):
            self.A[k] = 0.0
        for j in range(STATES):
            self.A[j * WIDTH + 2 + j] = 1.0

    def _average(self) -> None:
        """Set mean and variance of f from those of the strata."""
        rate = spread = 0.0
        # [18] Eq. (19).
        for m in range(self.M):
            rate += self.weight[m] * self.mean[m]
        for m in range(self.M):
            off = self.mean[m] - rate
            spread += self.weight[m] * (self.variance[m] + off * off)
        self.rate, self.rate_variance = rate, spread

    def reinit_motion(self, start: Start) -> None:
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
        # [2] Eq. (14).
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
        self._eval_row(A, 0, self.v, 0)

    def follow(self, speed: float, K: vec[float]) -> None:
        """Update x with a measured speed [m/s] that carries no information on f, by the gain K, shape (n,)."""
        A = self.A
        for k in range(WIDTH):
            # [7] Eq. (21).
            nu = (speed if k == 0 else 0.0) - A[k]
            for j in range(STATES):
                A[j * WIDTH + k] += K[j] * nu

    def _eval_row(self, row: vec[float], at: i64, out: vec[float], to: i64) -> None:
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

    def _flush_if_coupled(self) -> None:
        """Apply A if it mixes the x0 of states, as after a measured speed; v has been predicted anyway."""
        for j in range(1, STATES):
            for k in range(STATES):
                if k != j and self.A[j * WIDTH + 2 + k] != 0.0:
                    self._apply_transform()
                    return

    def _apply_transform(self) -> None:
        """Move the particles by A, which then is the identity."""
        M = self.M
        means, slopes = zeros(STATES), zeros(int(STATES * M))
        for j in range(STATES):
            self._eval_row(self.A, j * WIDTH, self._next, j * self.N)
            means[j] = self.expected(j)
            for m in range(M):
                slopes[j * M + m] = self._slope_of(j, m)
        self.x, self._next, self.x_mean, self.slope = self._next, self.x, means, slopes
        self._reset_transform()

    def _slope_of(self, j: i64, m: i64) -> float:
        """Return the regression of the j-th state on f in a stratum."""
        slope = self.A[j * WIDTH + 1]
        for k in range(STATES):
            slope += self.A[j * WIDTH + 2 + k] * self.slope[k * self.M + m]
        return slope

    def expected(self, j: i64) -> float:
        """Return the mean of the j-th state."""
        return self._expected(self.A, j * WIDTH)

    def _expected(self, row: vec[float], at: i64) -> float:
        """Return the mean of a row [1, f, x0] that begins at ``at``."""
        mean = row[at] + row[at + 1] * self.rate
        for k in range(STATES):
            mean += row[at + 2 + k] * self.x_mean[k]
        return mean

    def speed_spread(self) -> float:
        """Return the variance of the predicted speeds [(m/s)^2]."""
        return self._spread(self.v, self.expected(_V))

    def spread(self, j: i64) -> float:
        """Return the variance of the j-th state over the particles."""
        self._eval_row(self.A, j * WIDTH, self._row, 0)
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
        self._eval_row(row, 0, self._row, 0)
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

    def inflate_variance(self, step: Transition, variance: float) -> None:
        """Add to the variance of f [1] the drift before the predicted step, by spreading the values."""
        total, rate, N, M = self.rate_variance, self.rate, self.N, self.M
        if total <= 0.0:
            return
        self._apply_transform()
        # [8]
        ratio = math.sqrt(1.0 + variance / total)
        for i in range(N):
            wider = (ratio - 1.0) * (self.f[i] - rate)
            self.f[i] += wider
            self.x[_V * N + i] += step.gain_v * wider
            self.x[_A * N + i] += step.gain_a * wider
            self.v[i] = self.x[_V * N + i]
        for m in range(M):
            self.mean[m] = rate + ratio * (self.mean[m] - rate)
            self.variance[m] *= ratio * ratio
            self.slope[_V * M + m] += (ratio - 1.0) * step.gain_v
            self.slope[_A * M + m] += (ratio - 1.0) * step.gain_a
            for j in range(STATES):
                self.slope[j * M + m] /= ratio

    def update(
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
        """Branch, weigh and prune predicted particles; return the effective number of children [1].

        Args:
            step: Motion model since the last sample.
            walk: Variance q dt of f [1] in each stratum, shape (M,).
            speed: Measured speed [m/s].
            K: Gain, eq. (20), shape (n,).
            S: Variance of the innovation, eq. (16) [(m/s)^2].
            largest: Largest rate f_max [1].
            chain: Transition probabilities from stratum (row) to stratum (column), shape (M, M).
            uniforms: A draw in [0, 1) for each stratum, shape (M,).
        """
        self._flush_if_coupled()
        self._branch(step, walk, speed)
        effective = self._weigh(1.0 / math.sqrt(S), largest)
        self._sum_rates(chain)
        self._sort()
        for m in range(self.M):
            self._prune(m, chain, uniforms[int(m)])
            self._match(m)
        for j in range(STATES):
            self._correct(j, K[j])
            self._copy_to_survivors(j, chain)
        self.x, self._next, self.f, self._next_f = self._next, self.x, self._next_f, self.f
        self._reset_transform()
        self._take_moments()
        return effective

    def _branch(self, step: Transition, walk: vec[float], speed: float) -> None:
        """Shrink the strata; set step and slopes within their groups, and the innovations of the middle children."""
        base, moved, nu, M, f, v = self._base, self._moved, self._nu, self.M, self.f, self.v
        for m in range(M):
            kernel = _KAPPA * _KAPPA * self.variance[m]
            both = max(walk[m] + kernel, _TINY)
            # [10]
            self._h[m] = math.sqrt(3.0 * both)
            # The kernel moves f over its entire past, so x along its regression; the walk moves f in this step only.
            for j in range(STATES):
                gain = step.gain_v if j == _V else step.gain_a if j == _A else 0.0
                slope = self._slope_of(j, m)
                self._slopes[j * M + m] = slope
                self._c[j * M + m] = gain + kernel / both * (slope - gain)
            self._c_v[m] = self._c[_V * M + m]
            mean, slope = self.mean[m], self._slopes[_V * M + m]
            for i in range(self.edges[m], self.edges[m + 1]):
                # [9]
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
                    # [11] Eq. (17).
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
        # [12] Eq. (18).
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
            self._sum_w[m], self._sum_wf[m], self._sum_wff[m] = ones, firsts, squares
            self._sum_woff[m], self._sum_wfoff[m] = offs, products
        for m in range(M):
            # [13]
            weight = max(self._mix_into(self._sum_w, chain, m), _TINY)
            mean = self._mix_into(self._sum_wf, chain, m) / weight
            square = self._mix_into(self._sum_wff, chain, m) / weight
            self._next_weight[m], self._next_mean[m] = weight, mean
            self._next_variance[m] = max(square - mean * mean, _MIN_VARIANCE)

    def _mix_into(self, sums: vec[float], chain: vec[float], m: i64) -> float:
        """Return the sums of the strata, shape (M,), mixed by the transition matrix into the m-th."""
        total = 0.0
        for source in range(self.M):
            total += sums[source] * chain[source * self.M + m]
        return total

    def _sort(self) -> None:
        """Put the children in the order of f, equal ones in that of their numbers, by merging runs in order.

        Survivors are in order, so there is a run for each child of the group in each stratum.
        """
        rates, order, runs, count = self._rates, self._order, self._runs, 3 * self.N
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
                self._merge(runs[pair], runs[pair + 1], runs[pair + 2] if pair + 1 < last else runs[pair + 1])
                runs[pair // 2] = runs[pair]
                pair += 2
            last = (last + 1) // 2
            runs[last] = count
            self._order, self._merged = self._merged, self._order

    def _merge(self, low: i64, middle: i64, high: i64) -> None:
        """Merge the runs from ``low`` and from ``middle``, up to ``high``."""
        rates, order, merged = self._rates, self._order, self._merged
        i, j = low, middle
        for k in range(low, high):
            if i < middle and (j >= high or rates[order[i]] <= rates[order[j]]):
                merged[k] = order[i]
                i += 1
            else:
                merged[k] = order[j]
                j += 1

    def _prune(self, m: i64, chain: vec[float], uniform: float) -> None:
        """Choose the survivors of a stratum by systematic resampling of all children, with a draw in [0, 1)."""
        order, rates, w, of, share, N, M = self._order, self._rates, self._w, self._of, self._share, self.N, self.M
        parent, off, f = self._parent, self._off, self._next_f
        low, high = self.edges[m], self.edges[m + 1]
        size = float(high - low)
        for source in range(M):
            share[source] = chain[source * M + m] / self._next_weight[m]
        # [14]
        place: i64 = 0
        child = order[0]
        total = w[child] * share[of[child]]
        for k in range(low, high):
            position = (float(k - low) + uniform) / size
            while total <= position and place < 3 * N - 1:
                place += 1
                child = order[place]
                total += w[child] * share[of[child]]
            side = -1.0 if child < N else 0.0 if child < 2 * N else 1.0
            parent[k], off[k], f[k] = child % N, side * self._h[of[child]], rates[child]

    def _match(self, m: i64) -> None:
        """Shift and scale the survivors of a stratum to the mean and the variance of f before pruning."""
        f, shift, low, high = self._next_f, self._shift, self.edges[m], self.edges[m + 1]
        size, average, spread = float(high - low), 0.0, 0.0
        for k in range(low, high):
            average += f[k]
        average /= size
        for k in range(low, high):
            spread += (f[k] - average) * (f[k] - average)
        # [15]
        factor = min(math.sqrt(self._next_variance[m] / max(spread / size, _TINY)), _MAX_SPREAD_FACTOR)
        mean = self.rate + self._next_mean[m]
        for k in range(low, high):
            matched = mean + factor * (f[k] - average)
            shift[k] = matched - f[k]
            f[k] = matched

    def _correct(self, j: i64, K: float) -> None:
        """Update a state of the middle children, eq. (21), and sum it over the children of each stratum."""
        moved, nu, w0, wf, row, c = self._moved, self._nu, self._w0, self._wf, self._row, self._c
        f, x, N, M = self.f, self.x, self.N, self.M
        at = j * N
        # The speeds have been predicted; of another state only its own share and f are in A.
        known, gain, decay = self.A[j * WIDTH], self.A[j * WIDTH + 1], self.A[j * WIDTH + 2 + j]
        if j == _V:
            x, at, known, gain, decay = self.v, 0, 0.0, 0.0, 1.0
        for m in range(M):
            slope = self._slopes[j * M + m]
            c[j * M + m] -= K * self._c_v[m]
            states = products = 0.0
            for i in range(self.edges[m], self.edges[m + 1]):
                # [16] Eq. (21).
                state = known + gain * f[i] + decay * x[at + i] + slope * moved[i] + K * nu[i]
                row[i] = state
                states += state * w0[i]
                products += state * wf[i]
            self._sum_wx[m] = states + c[j * M + m] * self._sum_woff[m]
            self._sum_wxf[m] = products + c[j * M + m] * self._sum_wfoff[m]

    def _copy_to_survivors(self, j: i64, chain: vec[float]) -> None:
        """Take a state over to the survivors, and match its mean and its regression on f before pruning."""
        row, parent, off, shift, of, c = self._row, self._parent, self._off, self._shift, self._of, self._c
        N, M, after, average = self.N, self.M, self._next, 0.0
        for m in range(M):
            low, high, weight = self.edges[m], self.edges[m + 1], self._next_weight[m]
            mean = self._mix_into(self._sum_wx, chain, m) / weight
            product = self._mix_into(self._sum_wxf, chain, m) / weight
            slope = (product - mean * self._next_mean[m]) / self._next_variance[m]
            self.slope[j * M + m] = slope
            total = 0.0
            for k in range(low, high):
                i = parent[k]
                # [17]
                state = row[i] + off[k] * c[j * M + of[i]] + slope * shift[k]
                after[j * N + k] = state
                total += state
            back = mean - total / float(high - low)
            for k in range(low, high):
                after[j * N + k] += back
            average += weight * mean
        self.x_mean[j] = average

    def _take_moments(self) -> None:
        total = 0.0
        for m in range(self.M):
            total += self._next_weight[m]
        for m in range(self.M):
            self.weight[m] = self._next_weight[m] / total
            self.mean[m] = self.rate + self._next_mean[m]
            self.variance[m] = self._next_variance[m]
        # [19] Eq. (22).
        for j in range(STATES):
            self.x_mean[j] /= total
        self._average()
