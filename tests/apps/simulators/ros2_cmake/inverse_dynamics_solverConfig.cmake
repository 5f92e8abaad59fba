# As the package itself: headers without a target.
set(inverse_dynamics_solver_INCLUDE_DIRS ${CMAKE_CURRENT_LIST_DIR}/../ros2_headers)
