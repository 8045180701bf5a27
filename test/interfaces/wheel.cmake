# The steps that the packages beside this file share: build an interface package for a wheel with
# nothing but the ros-jazzy-* wheels that pip put into the build environment.

if(DEFINED ENV{ROS_DISTRO})
  message(FATAL_ERROR
    "ROS $ENV{ROS_DISTRO} is sourced: use its released ${PROJECT_NAME}, not this stand-in")
endif()

# Found through PATH, which holds the bin folder of the build environment. The generators look
# the type supports up in the ament index of that environment.
find_package(ament_cmake REQUIRED)
get_filename_component(_prefix "${ament_cmake_DIR}/../../.." ABSOLUTE)
set(ENV{AMENT_PREFIX_PATH} "${_prefix}")
list(PREPEND CMAKE_PREFIX_PATH "${_prefix}")

find_package(rosidl_cmake REQUIRED)
find_package(rosidl_typesupport_fastrtps_c REQUIRED)
find_package(rosidl_generator_py REQUIRED)

# interface_wheel(<package> ...): generate msg/*.msg, which use messages of the packages named.
macro(interface_wheel)
  foreach(_package builtin_interfaces ${ARGN})
    find_package(${_package} REQUIRED)
    # The wheels name folders with Python headers that only the machine that built them had.
    set(_target ${_package}::${_package}__rosidl_generator_py)
    get_target_property(_folders ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    list(FILTER _folders EXCLUDE REGEX "^/opt/python")
    set_target_properties(${_target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${_folders}")
  endforeach()

  file(GLOB _messages RELATIVE "${CMAKE_CURRENT_SOURCE_DIR}" msg/*.msg)
  rosidl_generate_interfaces(${PROJECT_NAME} ${_messages} DEPENDENCIES ${ARGN})
  ament_package()
endmacro()
