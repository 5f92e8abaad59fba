add_library(pluginlib::pluginlib INTERFACE IMPORTED)
target_include_directories(pluginlib::pluginlib INTERFACE
  ${CMAKE_CURRENT_LIST_DIR}/../ros2_headers)

macro(pluginlib_export_plugin_description_file category file)
  if(NOT EXISTS ${CMAKE_CURRENT_SOURCE_DIR}/${file})
    message(FATAL_ERROR "${file} is missing")
  endif()
endmacro()
