// Inverse dynamics of {{ robot }} as identified by asbuilt: {{ origin }}
#pragma once

#include <cstddef>
#include <string>

#include <eigen3/Eigen/Core>

#include "inverse_dynamics_solver/inverse_dynamics_solver.hpp"

namespace {{ package }}
{

/// Joints in the order of all vectors: {{ joints }}
constexpr std::size_t kJoints = {{ n }};

/// Everything that was identified: links on a tilted base, springs, drives, friction.
class AsBuilt : public inverse_dynamics_solver::InverseDynamicsSolver
{
public:
  /// Needs no parameter and no description: the numbers are in the code.
  void initialize(
    rclcpp::node_interfaces::NodeParametersInterface::ConstSharedPtr parameters_interface = nullptr,
    const std::string & param_namespace = "", const std::string & robot_description = "") override;

  /// Mass matrix, with the armatures of the drives.
  Eigen::MatrixXd getInertiaMatrix(const Eigen::VectorXd & joint_positions) const override;

  /// C(q, qd) qd.
  Eigen::VectorXd getCoriolisVector(
    const Eigen::VectorXd & joint_positions,
    const Eigen::VectorXd & joint_velocities) const override;

  /// What holds the robot at rest: gravity, springs and the offsets of the drives.
  Eigen::VectorXd getGravityVector(const Eigen::VectorXd & joint_positions) const override;

  /// Friction at joint positions of zero; only friction under load depends on positions.
  Eigen::VectorXd getFrictionVector(const Eigen::VectorXd & joint_velocities) const override;

  /// The identified torque of a motion, friction included.
  Eigen::VectorXd getTorques(
    const Eigen::VectorXd & joint_positions, const Eigen::VectorXd & joint_velocities,
    const Eigen::VectorXd & joint_accelerations) const override;

  /// The same without allocation, for arrays of kJoints numbers.
  static void computeTorques(
    const double * q, const double * qd, const double * qdd, double * tau) noexcept;
};

/// As AsBuilt, but getTorques leaves friction out, for controllers that add getFrictionVector.
class AsBuiltWithoutFriction : public AsBuilt
{
public:
  Eigen::VectorXd getTorques(
    const Eigen::VectorXd & joint_positions, const Eigen::VectorXd & joint_velocities,
    const Eigen::VectorXd & joint_accelerations) const override;
};

}  // namespace {{ package }}
