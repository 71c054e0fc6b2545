// SPDX-License-Identifier: Apache-2.0
// Resistance, force and stopping distance of docs/controller.md, without ROS. SI units, w and gradients in N/kN.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

namespace trainid {

constexpr double G = 9.80665;
using Davis = std::array<double, 3>;  // a, b, c
using Covariance = std::array<double, 9>;  // of a, b, c, row-major

inline double resistance(const Davis & w, double v) {return w[0] + v * (w[1] + v * w[2]);}

inline double resistance_std(const Covariance & P, double v) {
  const std::array<double, 3> phi{1.0, v, v * v};
  double variance = 0.0;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {variance += phi[i] * P[3 * i + j] * phi[j];}
  }
  return std::sqrt(std::max(0.0, variance));
}

// Force [N] for an acceleration [m/s^2]; scale is ResistanceEstimate.force_scale, 1 where that is NaN.
inline double feed_forward(
  double mass, double rotary_mass, double w, double gradient, double acceleration, double scale = 1.0) {
  const double force = mass * ((1.0 + rotary_mass) * acceleration + 0.001 * G * (w + gradient));
  return force > 0.0 ? force / scale : force;
}

// Parameters of a stop, in this order, and their standard deviations; those of a, b, c are in the covariance.
enum Parameter {RATE, SLOPE, CHANGEOVER, A, B, C, GRADIENT, DELAY, LAG, COUNT};
using Theta = std::array<double, COUNT>;

struct Train {
  double rotary_mass, max_speed, blend_speed;
  std::vector<std::pair<double, double>> rate_table;  // speed and rate; empty: 1
};

inline double table(const Train & train, double v) {
  const auto & rows = train.rate_table;
  if (rows.empty()) {return 1.0;}
  if (v <= rows.front().first) {return rows.front().second;}
  for (std::size_t k = 1; k < rows.size(); ++k) {
    const double width = rows[k].first - rows[k - 1].first, ahead = v - rows[k - 1].first;
    if (ahead < width) {return rows[k - 1].second + (rows[k].second - rows[k - 1].second) * ahead / width;}
  }
  return rows.back().second;
}

// Distance [m] from a speed [m/s] with a brake target [m/s^2, > 0]; infinite if the train does not stop.
inline double stopping_distance(const Train & train, const Theta & p, double speed, double command) {
  const double k = G / (1000.0 * (1.0 + train.rotary_mass)), dt = 0.02;
  const auto deceleration = [&](double t, double v) {
      const double since = t - p[DELAY];
      const double built_up = since <= 0.0 ? 0.0 : p[LAG] > 0.0 ? -std::expm1(-since / p[LAG]) : 1.0;
      const double by_speed = p[SLOPE] * (std::min(v / train.max_speed, 1.0) - 0.5) +
        p[CHANGEOVER] * std::max(0.0, 1.0 - std::abs(v / train.blend_speed - 1.0));
      const double w = p[A] + p[GRADIENT] + v * (p[B] + v * p[C]);
      return table(train, v) * (p[RATE] + by_speed) * command * built_up + k * w;
    };
  const double built_up = p[DELAY] + 10.0 * p[LAG];
  double distance = 0.0, v = speed, t = 0.0;
  while (v < 400.0) {
    const double d0 = deceleration(t, v);
    if (t > built_up && d0 <= 0.0) {break;}
    const double step = t > built_up ? std::max(dt, 0.005 * v / d0) : dt;
    const double d = deceleration(t + 0.5 * step, v - 0.5 * step * d0);
    if (v - step * d <= 0.0) {return distance + 0.5 * v * v / d;}
    distance += step * (v - 0.5 * step * d);
    v -= step * d;
    t += step;
  }
  return std::numeric_limits<double>::infinity();
}

// Covariance times a gradient.
inline Theta spread_of(const Theta & stds, const Covariance & P, const Theta & slope) {
  Theta out{};
  for (int j = 0; j < COUNT; ++j) {out[j] = stds[j] * stds[j] * slope[j];}
  for (int i = 0; i < 3; ++i) {out[A + i] = P[3 * i] * slope[A] + P[3 * i + 1] * slope[B] + P[3 * i + 2] * slope[C];}
  return out;
}

inline double dot(const Theta & x, const Theta & y) {
  return std::inner_product(x.begin(), x.end(), y.begin(), 0.0);
}

// Whether the built-up brake decelerates at all speeds up to one with the probability of z standard deviations.
inline bool may_stop(
  const Train & train, const Theta & mean, const Theta & stds, const Covariance & P, double speed, double command,
  double z) {
  const double k = G / (1000.0 * (1.0 + train.rotary_mass));
  for (int n = 0; n <= 400; ++n) {
    const double v = speed * n / 400.0, u = table(train, v) * command;
    const double m = std::max(0.0, 1.0 - std::abs(v / train.blend_speed - 1.0));
    const Theta slope{u, u * (std::min(v / train.max_speed, 1.0) - 0.5), u * m, k, k * v, k * v * v, k, 0.0, 0.0};
    if (dot(slope, mean) <= z * std::sqrt(dot(slope, spread_of(stds, P, slope)))) {return false;}
  }
  return true;
}

// Distance within which the train stops with the probability of z standard deviations (1.645: 95 %); infinite where it
// may not stop. The client does the same with exact derivatives.
inline double stopping_bound(
  const Train & train, const Theta & mean, const Theta & stds, const Covariance & P, double speed, double command,
  double z) {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  if (!may_stop(train, mean, stds, P, speed, command, z)) {return infinity;}
  Theta at = mean;
  double distance = stopping_distance(train, at, speed, command);
  for (int iteration = 0; iteration < 200 && std::isfinite(distance); ++iteration) {
    Theta slope{};
    for (int j = 0; j < COUNT; ++j) {
      const double h = 1e-4 * std::max(0.1, std::abs(mean[j]));
      Theta above = at, below = at;
      above[j] += h, below[j] -= h;
      slope[j] = (stopping_distance(train, above, speed, command) - stopping_distance(train, below, speed, command)) /
        (2.0 * h);
    }
    const Theta spread = spread_of(stds, P, slope);
    const double variance = dot(spread, slope);
    if (!std::isfinite(variance)) {return infinity;}
    for (int j = 0; j < COUNT; ++j) {at[j] = mean[j] + (variance > 0.0 ? z / std::sqrt(variance) : 0.0) * spread[j];}
    at[DELAY] = std::max(0.0, at[DELAY]), at[LAG] = std::max(0.0, at[LAG]);
    const double before = distance;
    distance = stopping_distance(train, at, speed, command);
    if (iteration > 0 && std::abs(distance - before) <= 1e-6 * distance) {return distance;}
  }
  return infinity;
}

}  // namespace trainid
