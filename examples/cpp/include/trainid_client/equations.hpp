// SPDX-License-Identifier: Apache-2.0
// Resistance, force and stopping distance of docs/client_reference.md, without ROS. SI units, w and gradients in N/kN.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <iterator>
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

// Strongest brake target [m/s^2, > 0] that the adhesion of a slide and its standard deviation permit with the
// probability of z standard deviations, where the brake has its largest rate; the adhesion is log-normal.
inline double adhesive_limit(const Train & train, double rate, double adhesion, double sigma, double z) {
  double most = train.rate_table.empty() ? 1.0 : 0.0;
  for (const auto & row : train.rate_table) {most = std::max(most, row.second);}
  return G / (1.0 + train.rotary_mass) * adhesion * std::exp(-z * sigma / adhesion) / (rate * most);
}

// Speeds [m/s] from 0 to one [m/s, > 0] between which the brake rate is smooth.
inline std::vector<double> knots(const Train & train, double speed) {
  std::vector<double> all{train.blend_speed, 2.0 * train.blend_speed, train.max_speed}, out{0.0};
  for (const auto & row : train.rate_table) {all.push_back(row.first);}
  std::sort(all.begin(), all.end());
  std::copy_if(all.begin(), all.end(), std::back_inserter(out), [&](double v) {return 0.0 < v && v < speed;});
  out.push_back(speed);
  return out;
}

inline double dot(const Theta & x, const Theta & y) {
  return std::inner_product(x.begin(), x.end(), y.begin(), 0.0);
}

// Derivatives by the parameters of the deceleration at a brake target [m/s^2]; it is linear in them and in the target.
inline Theta by_parameters(const Train & train, double v, double target) {
  const double k = G / (1000.0 * (1.0 + train.rotary_mass)), r = table(train, v) * target;
  const double slope = std::min(v / train.max_speed, 1.0) - 0.5;
  const double changeover = std::max(0.0, 1.0 - std::abs(v / train.blend_speed - 1.0));
  return {r, r * slope, r * changeover, k, k * v, k * v * v, k, 0.0, 0.0};
}

// Distance [m], infinite if the train does not stop, and its derivatives by the parameters.
struct Stop {
  double distance = 0.0;
  Theta gradient{};
};

// Stops from a released brake with a brake target [m/s^2, > 0]. The balance is integrated over time until the brake is
// built up, then over speed. The derivatives are those of the adjoint equation, within a few per cent: up to 7 % too
// small if the train stops while the brake builds up.
class Braking {
public:
  Braking(const Train & train, const Theta & p, double command)
  : train_(train), p_(p), command_(command), dead_steps_(static_cast<int>(std::ceil(std::max(0.0, p[DELAY]) / 0.8))) {}

  Stop from(double speed) const {
    Stop out;
    std::vector<double> times{0.0}, speeds{speed};
    for (const double planned : ends_of_steps()) {
      const double t = times.back(), v = speeds.back();
      const double after = step(t, v, planned - t).first;
      const double end = after > 0.0 ? planned : t + time_of_stop(t, v, planned - t);
      out.distance += step(t, v, end - t).second;
      times.push_back(end);
      speeds.push_back(std::max(0.0, after));
      if (after <= 0.0) {break;}
      if (!(after <= 400.0)) {return {infinity, {}};}  // it runs away, or something is NaN
    }
    if (!(speeds.back() <= 0.0)) {hold(out, speeds.back());}
    if (std::isfinite(out.distance)) {go_back(out, times, speeds);}
    return out;
  }

private:
  static constexpr double infinity = std::numeric_limits<double>::infinity();

  double target(double t) const {
    const double since = t - p_[DELAY];
    if (since <= 0.0) {return 0.0;}
    return p_[LAG] > 0.0 ? -command_ * std::expm1(-since / p_[LAG]) : command_;
  }

  double deceleration(double v, double target) const {return dot(by_parameters(train_, v, target), p_);}

  // Ends [s] of the steps until the brake is built up.
  std::vector<double> ends_of_steps() const {
    std::vector<double> out;
    for (int n = 1; n <= dead_steps_; ++n) {out.push_back(p_[DELAY] * n / dead_steps_);}
    for (const double x : {0.4, 0.8, 1.2, 1.7, 2.2, 2.8, 3.5, 4.3, 5.3, 6.5, 8.0, 10.0}) {
      if (p_[LAG] > 0.0) {out.push_back(p_[DELAY] + p_[LAG] * x);}
    }
    return out;
  }

  // Speed [m/s] after a step of Runge-Kutta, and its distance [m].
  std::pair<double, double> step(double t, double v, double dt) const {
    const double middle = target(t + 0.5 * dt);
    const double k1 = deceleration(v, target(t));
    const double k2 = deceleration(v - 0.5 * dt * k1, middle);
    const double k3 = deceleration(v - 0.5 * dt * k2, middle);
    const double k4 = deceleration(v - dt * k3, target(t + dt));
    return {v - dt * (k1 + 2.0 * (k2 + k3) + k4) / 6.0, dt * v - dt * dt * (k1 + k2 + k3) / 6.0};
  }

  // Time [s] from t until the train stands, at most dt.
  double time_of_stop(double t, double v, double dt) const {
    double low = 0.0, high = dt;
    for (int n = 0; n < 50; ++n) {
      const double middle = 0.5 * (low + high);
      (step(t, v, middle).first > 0.0 ? low : high) = middle;
    }
    return low;
  }

  // Adds the stop from a speed with the brake built up.
  void hold(Stop & out, double speed) const {
    const std::vector<double> ends = knots(train_, speed);
    for (std::size_t n = 1; n < ends.size(); ++n) {hold_between(out, ends[n - 1], ends[n], 12);}
  }

  // Adds the way between two speeds (Gauss-Legendre), in halves where the deceleration varies much.
  void hold_between(Stop & out, double low, double high, int halvings) const {
    constexpr std::array<double, 5> nodes{
      0.04691007703066802, 0.23076534494715845, 0.5, 0.7692346550528415, 0.953089922969332};
    constexpr std::array<double, 5> weights{
      0.11846344252809454, 0.23931433524968324, 0.28444444444444444, 0.23931433524968324, 0.11846344252809454};
    const auto [least, most] = std::minmax({deceleration(low, command_), deceleration(high, command_)});
    if (least > 0.0 && most > 2.0 * least && halvings > 0) {
      hold_between(out, low, 0.5 * (low + high), halvings - 1);
      hold_between(out, 0.5 * (low + high), high, halvings - 1);
      return;
    }
    for (int j = 0; j < 5; ++j) {
      const double v = low + (high - low) * nodes[j], d = deceleration(v, command_);
      const double run = least > 0.0 && d > 0.0 ? (high - low) * weights[j] * v / d : infinity;
      out.distance += run;
      add(out.gradient, -run / d, by_parameters(train_, v, command_));
    }
  }

  static void add(Theta & sum, double weight, const Theta & x) {
    for (int j = 0; j < COUNT; ++j) {sum[j] += weight * x[j];}
  }

  // Adds the derivatives during the steps. The costate [s], that of the distance to go by the speed, follows backwards
  // from its value at their end (trapezoidal rule).
  void go_back(Stop & out, const std::vector<double> & times, const std::vector<double> & speeds) const {
    const int last = static_cast<int>(times.size()) - 1;
    double costate = speeds[last] > 0.0 ? speeds[last] / deceleration(speeds[last], command_) : 0.0;
    double after = by_speed(times[last], speeds[last]);
    for (int n = last; n >= 0; --n) {
      const double t = times[n], v = speeds[n], here = by_speed(t, v);
      const double dt = n < last ? times[n + 1] - t : 0.0, dt_before = n > 0 ? t - times[n - 1] : 0.0;
      costate = (costate * (1.0 - 0.5 * dt * after) + dt) / (1.0 + 0.5 * dt * here);
      after = here;
      const double weight = -0.5 * (dt + dt_before) * costate;
      add(out.gradient, weight, by_parameters(train_, v, target(t)));
      out.gradient[LAG] += weight * by_lag(t, v);
      if (n == dead_steps_) {out.gradient[DELAY] = v - costate * deceleration(v, 0.0);}
    }
  }

  // Derivative of the deceleration by speed [1/s].
  double by_speed(double t, double v) const {
    return (deceleration(v + 0.01, target(t)) - deceleration(v - 0.01, target(t))) / 0.02;
  }

  // Derivative of the deceleration by the time constant [m/s^3].
  double by_lag(double t, double v) const {
    const double since = t - p_[DELAY], lag = p_[LAG];
    if (since <= 0.0 || lag <= 0.0) {return 0.0;}
    const double target_by_lag = -command_ * std::exp(-since / lag) * since / (lag * lag);
    return deceleration(v, target_by_lag) - deceleration(v, 0.0);
  }

  Train train_;
  Theta p_;
  double command_;
  int dead_steps_;
};

// Distance [m] from a speed [m/s] with a brake target [m/s^2, > 0]; infinite if the train does not stop.
inline double stopping_distance(const Train & train, const Theta & p, double speed, double command) {
  return Braking(train, p, command).from(speed).distance;
}

// Covariance times a gradient.
inline Theta spread_of(const Theta & stds, const Covariance & P, const Theta & slope) {
  Theta out{};
  for (int j = 0; j < COUNT; ++j) {out[j] = stds[j] * stds[j] * slope[j];}
  for (int i = 0; i < 3; ++i) {out[A + i] = P[3 * i] * slope[A] + P[3 * i + 1] * slope[B] + P[3 * i + 2] * slope[C];}
  return out;
}

// Standard deviation along a gradient.
inline double deviation(const Theta & stds, const Covariance & P, const Theta & slope) {
  return std::sqrt(std::max(dot(slope, spread_of(stds, P, slope)), 0.0));  // in this order NaN stays NaN
}

// Whether the built-up brake decelerates at all speeds up to one with the probability of z standard deviations.
inline bool may_stop(
  const Train & train, const Theta & mean, const Theta & stds, const Covariance & P, double speed, double command,
  double z) {
  const auto slows_down = [&](double v) {
      const Theta slope = by_parameters(train, v, command);
      return dot(slope, mean) - z * deviation(stds, P, slope) > 0.0;
    };
  const std::vector<double> ends = knots(train, 150.0);
  for (std::size_t n = 1; n < ends.size(); ++n) {
    for (const double share : {0.0, 0.25, 0.5, 0.75}) {
      const double v = ends[n - 1] + share * (ends[n] - ends[n - 1]);
      if (v <= speed && !slows_down(v)) {return false;}
    }
  }
  return slows_down(speed);
}

// Distance [m] within which the train stops with the probability of z standard deviations (1.645: 95 %) from a speed
// [m/s, at most 150]; infinite where it may not stop. The same as in the client: the longest distance of all parameters
// that are z standard deviations from their mean, found by iteration.
inline double stopping_bound(
  const Train & train, const Theta & mean, const Theta & stds, const Covariance & P, double speed, double command,
  double z) {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  if (!may_stop(train, mean, stds, P, speed, command, z)) {return infinity;}
  Stop found = Braking(train, mean, command).from(speed);
  for (int n = 0; n <= 200 && std::isfinite(found.distance); ++n) {
    const Theta spread = spread_of(stds, P, found.gradient);
    const double sigma = deviation(stds, P, found.gradient);
    Theta at = mean;
    for (int j = 0; j < COUNT; ++j) {at[j] += sigma > 0.0 ? z / sigma * spread[j] : 0.0;}
    at[DELAY] = std::max(0.0, at[DELAY]);
    at[LAG] = std::max(0.0, at[LAG]);
    if (at[RATE] < 1e-3) {return infinity;}  // no brake
    const double before = found.distance;
    found = Braking(train, at, command).from(speed);
    if (n > 0 && std::abs(found.distance - before) <= 1e-9 * before) {return found.distance;}
  }
  return infinity;
}

}  // namespace trainid
