// SPDX-License-Identifier: Apache-2.0
// Uses the live estimates while they are fit to use, else the values of the train file.
#include <algorithm>
#include <chrono>
#include <memory>
#include <optional>
#include <string>

#include "rclcpp/rclcpp.hpp"
#include "trainid_client/equations.hpp"
#include "trainid_msgs/msg/adhesion_estimate.hpp"
#include "trainid_msgs/msg/brake_rate_estimate.hpp"
#include "trainid_msgs/msg/resistance_estimate.hpp"

using trainid_msgs::msg::AdhesionEstimate;
using trainid_msgs::msg::BrakeRateEstimate;
using trainid_msgs::msg::ResistanceEstimate;

template<class Estimate>
class Newest {
public:
  Newest(rclcpp::Node * node, const std::string & name) {
    const auto take = [this, node](const Estimate & message) {newest_ = message; at_ = node->now();};
    const auto join = [this, take](const Estimate & message) {if (!newest_) {take(message);}};
    live_ = node->create_subscription<Estimate>("trainid/" + name, 10, take);
    latched_ = node->create_subscription<Estimate>(
      "trainid/last_valid/" + name, rclcpp::QoS(1).transient_local(), join);
  }
  // Silence is a reason to fall back, as is any other status.
  std::optional<Estimate> usable(const rclcpp::Time & now) const {
    const bool fresh = newest_ && (now - at_).seconds() <= 0.75;
    const bool fit = fresh && (newest_->status == Estimate::VALID || newest_->status == Estimate::HOLDING);
    return fit ? newest_ : std::nullopt;
  }

private:
  std::optional<Estimate> newest_;
  rclcpp::Time at_;
  typename rclcpp::Subscription<Estimate>::SharedPtr live_, latched_;
};

class Controller : public rclcpp::Node {
public:
  Controller()
  : Node("ato_controller"), w_(this, "resistance"), rate_(this, "brake_rate") {
    rail_ = create_subscription<AdhesionEstimate>(
      "trainid/adhesion", 10, [this](const AdhesionEstimate & message) {look(message);});
    timer_ = create_wall_timer(std::chrono::milliseconds(100), [this]() {step();});
  }

private:
  // A slide limits the braking until an estimate that is fit says that no axle slipped in the last km.
  void look(const AdhesionEstimate & rail) {
    const bool fit = rail.status == AdhesionEstimate::VALID || rail.status == AdhesionEstimate::HOLDING;
    if (!(rail.adhesion > 0.0) || !(fit || rail.slip < 0.0)) {return;}
    may_be_slide_ = rail.slip < 0.0 || (may_be_slide_ && (rail.slipping || rail.slip_share > 0.0));
    slide_ = may_be_slide_ ? std::optional<AdhesionEstimate>(rail) : std::nullopt;
  }

  void step() {
    trainid::Covariance P{0.61, 0, 0, 0, 6.25e-4, 0, 0, 0, 2.61e-6};  // of the train file, as are these
    trainid::Theta p{1.0, 0, 0, 1.0, 0.03, 0.003, 0.0, 0.6, 0.4}, stds{0.2, 0.08, 0.06, 0, 0, 0, 0.2, 0.108, 0.057};
    if (const auto w = w_.usable(now())) {P = w->covariance; p[3] = w->a; p[4] = w->b; p[5] = w->c;}
    if (const auto f = rate_.usable(now())) {p[0] = f->brake_rate; stds[0] = f->brake_rate_std;}
    double command = 0.8;
    if (slide_) {
      const double most = trainid::adhesive_limit(train_, p[0], slide_->adhesion, slide_->adhesion_std, 1.645);
      command = std::min(command, most);
    }
    const double bound = trainid::stopping_bound(train_, p, stds, P, 20.0, command, 1.645);
    RCLCPP_INFO(get_logger(), "stops from 20 m/s within %.1f m (95 %%)", bound);
  }

  trainid::Train train_{0.08, 22.2, 2.5, {}};
  Newest<ResistanceEstimate> w_;
  Newest<BrakeRateEstimate> rate_;
  bool may_be_slide_ = true;
  std::optional<AdhesionEstimate> slide_;
  rclcpp::Subscription<AdhesionEstimate>::SharedPtr rail_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int argc, char ** argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Controller>());
}
