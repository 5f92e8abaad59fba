// Checks that an exported class can be made and used as its base, for tests without ROS.
#pragma once
#include <memory>
#include <type_traits>
#define PLUGINLIB_EXPORT_CLASS(Derived, Base) \
  static_assert(std::is_base_of<Base, Derived>::value, "plugins derive from their interface"); \
  static_assert(!std::is_abstract<Derived>::value, "plugins implement the whole interface"); \
  static_assert(std::is_default_constructible<Derived>::value, "plugins are made without arguments");
