#include "{{ package }}/solver.hpp"

#include <stdexcept>
#include <string>

#include <pluginlib/class_list_macros.hpp>

#include "{{ package }}/dynamics.h"

namespace {{ package }}
{

namespace
{

const double * check(const Eigen::VectorXd & values)
{
  if (static_cast<std::size_t>(values.size()) != kJoints) {
    throw std::invalid_argument(
      "{{ package }} has {{ n }} joints, got a vector of " + std::to_string(values.size()));
  }
  return values.data();
}

constexpr double kRest[kJoints] = {0.0};

}  // namespace

void AsBuilt::initialize(
  rclcpp::node_interfaces::NodeParametersInterface::ConstSharedPtr, const std::string &,
  const std::string &)
{
}

Eigen::MatrixXd AsBuilt::getInertiaMatrix(const Eigen::VectorXd & joint_positions) const
{
  double masses[kJoints * kJoints];
  {{ package }}_mass_matrix(check(joint_positions), masses);
  Eigen::MatrixXd M(kJoints, kJoints);
  for (std::size_t j = 0; j < kJoints; ++j) {
    for (std::size_t k = 0; k < kJoints; ++k) {
      M(j, k) = masses[j * kJoints + k];
    }
  }
  return M;
}

Eigen::VectorXd AsBuilt::getCoriolisVector(
  const Eigen::VectorXd & joint_positions, const Eigen::VectorXd & joint_velocities) const
{
  Eigen::VectorXd tau(kJoints);
  {{ package }}_coriolis(check(joint_positions), check(joint_velocities), tau.data());
  return tau;
}

Eigen::VectorXd AsBuilt::getGravityVector(const Eigen::VectorXd & joint_positions) const
{
  Eigen::VectorXd tau(kJoints);
  {{ package }}_inverse_dynamics(check(joint_positions), kRest, kRest, tau.data());
  return tau;
}

Eigen::VectorXd AsBuilt::getFrictionVector(const Eigen::VectorXd & joint_velocities) const
{
  Eigen::VectorXd tau(kJoints);
  double rest[kJoints];
  {{ package }}_friction(kRest, check(joint_velocities), tau.data());
  {{ package }}_friction(kRest, kRest, rest);
  for (std::size_t j = 0; j < kJoints; ++j) {
    tau(j) -= rest[j];
  }
  return tau;
}

Eigen::VectorXd AsBuilt::getTorques(
  const Eigen::VectorXd & joint_positions, const Eigen::VectorXd & joint_velocities,
  const Eigen::VectorXd & joint_accelerations) const
{
  Eigen::VectorXd tau(kJoints);
  computeTorques(
    check(joint_positions), check(joint_velocities), check(joint_accelerations), tau.data());
  return tau;
}

void AsBuilt::computeTorques(
  const double * q, const double * qd, const double * qdd, double * tau) noexcept
{
  {{ package }}_inverse_dynamics(q, qd, qdd, tau);
}

Eigen::VectorXd AsBuiltWithoutFriction::getTorques(
  const Eigen::VectorXd & joint_positions, const Eigen::VectorXd & joint_velocities,
  const Eigen::VectorXd & joint_accelerations) const
{
  Eigen::VectorXd tau = AsBuilt::getTorques(joint_positions, joint_velocities, joint_accelerations);
  double moving[kJoints];
  double rest[kJoints];
  {{ package }}_friction(joint_positions.data(), joint_velocities.data(), moving);
  {{ package }}_friction(joint_positions.data(), kRest, rest);
  for (std::size_t j = 0; j < kJoints; ++j) {
    tau(j) -= moving[j] - rest[j];
  }
  return tau;
}

}  // namespace {{ package }}

PLUGINLIB_EXPORT_CLASS(
  {{ package }}::AsBuilt, inverse_dynamics_solver::InverseDynamicsSolver)
PLUGINLIB_EXPORT_CLASS(
  {{ package }}::AsBuiltWithoutFriction, inverse_dynamics_solver::InverseDynamicsSolver)
