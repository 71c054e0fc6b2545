// SPDX-License-Identifier: Apache-2.0
// Resistance, force and stopping distance of docs/controller.md, without ROS. SI units, w and gradients in N/kN.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
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
  double distance = 0.0, v = speed;
  for (double t = 0.0; t < 600.0; t += dt) {
    const double half = v - 0.5 * dt * deceleration(t, v), d = deceleration(t + 0.5 * dt, half);
    if (v - dt * d <= 0.0) {return distance + 0.5 * v * v / d;}
    distance += dt * (v - 0.5 * dt * d);
    v -= dt * d;
  }
  return std::numeric_limits<double>::infinity();
}

// Distance within which the train stops with the probability of z standard deviations (1.645: 95 %).
inline double stopping_bound(
  const Train & train, const Theta & mean, const Theta & stds, const Covariance & P, double speed, double command,
  double z) {
  Theta at = mean;
  for (int iteration = 0; iteration < 2; ++iteration) {
    Theta slope{}, spread{};
    for (int j = 0; j < COUNT; ++j) {
      const double h = 1e-3 * std::max(0.1, std::abs(mean[j]));
      Theta above = at, below = at;
      above[j] += h, below[j] -= h;
      slope[j] = (stopping_distance(train, above, speed, command) - stopping_distance(train, below, speed, command)) /
        (2.0 * h);
    }
    double variance = 0.0;
    for (int j = 0; j < COUNT; ++j) {
      const bool is_davis = j >= A && j <= C;
      const int i = is_davis ? 3 * (j - A) : 0;
      spread[j] = is_davis ? P[i] * slope[A] + P[i + 1] * slope[B] + P[i + 2] * slope[C] : stds[j] * stds[j] * slope[j];
      variance += spread[j] * slope[j];
    }
    for (int j = 0; j < COUNT; ++j) {at[j] = mean[j] + (variance > 0.0 ? z / std::sqrt(variance) : 0.0) * spread[j];}
    at[DELAY] = std::max(0.0, at[DELAY]), at[LAG] = std::max(0.0, at[LAG]);
  }
  return stopping_distance(train, at, speed, command);
}

}  // namespace trainid
