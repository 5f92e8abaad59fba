// The torques of some states are those that asbuilt computes.
#include <cmath>
#include <cstdio>

#include "{{ package }}/solver.hpp"

namespace
{
constexpr std::size_t kStates = {{ states | length }};
const double kMotion[kStates][4][{{ package }}::kJoints] = {
{% for state in states %}
  { {% for row in state %}{ {{ row | join(", ") }} }{{ ", " if not loop.last }}{% endfor %} },
{% endfor %}
};
}  // namespace

int main()
{
  const {{ package }}::AsBuilt solver;
  double worst = 0.0;
  for (const auto & state : kMotion) {
    Eigen::VectorXd motion[3];
    for (int k = 0; k < 3; ++k) {
      motion[k] = Eigen::VectorXd({{ package }}::kJoints);
      for (std::size_t j = 0; j < {{ package }}::kJoints; ++j) {
        motion[k](j) = state[k][j];
      }
    }
    const Eigen::VectorXd tau = solver.getTorques(motion[0], motion[1], motion[2]);
    for (std::size_t j = 0; j < {{ package }}::kJoints; ++j) {
      worst = std::fmax(worst, std::fabs(tau(j) - state[3][j]));
    }
  }
  std::printf("largest torque error %.3g\n", worst);
  return worst <= 1e-9 ? 0 : 1;
}
