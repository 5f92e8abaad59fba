# The macros of ament_cmake that every ROS 2 since Humble has, for builds without ROS. Of
# ament_target_dependencies, which Lyrical dropped, there is none.
include(CTest)

macro(ament_export_dependencies)
  foreach(dependency ${ARGN})
    if(NOT ${dependency}_FOUND)
      message(FATAL_ERROR "${dependency} is exported, but was never found")
    endif()
  endforeach()
endmacro()

macro(ament_export_targets name)
  install(EXPORT ${name} NAMESPACE ${PROJECT_NAME}:: DESTINATION share/${PROJECT_NAME}/cmake)
endmacro()

macro(ament_package)
  install(FILES package.xml DESTINATION share/${PROJECT_NAME})
endmacro()
