# SPDX-License-Identifier: Apache-2.0
# What every package of interfaces/ does, for colcon and for scikit-build-core (pip, uv) alike.
#
#   interface_package([UPSTREAM] DEPENDENCIES <package>...)
#
# generates all of msg/*.msg, srv/*.srv and action/*.action. UPSTREAM marks a copy of a package that a native ROS 2 may
# provide: where that is so, nothing is built, and the installed package serves.

# The wheels' targets named *__rosidl_generator_py export the include folder of the Python that built them. Where that
# folder does not exist (everywhere else), CMake would stop there. Called from the package's own directory, because
# imported targets are visible only there.
function(drop_missing_include_folders)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    foreach(folder IN LISTS folders)
      if(IS_ABSOLUTE "${folder}" AND NOT EXISTS "${folder}")
        set_property(TARGET ${target} PROPERTY INTERFACE_INCLUDE_DIRECTORIES "")
        break()
      endif()
    endforeach()
  endforeach()
endfunction()

set(INTERFACE_PACKAGE_FOLDER "${CMAKE_CURRENT_LIST_DIR}")
if(SKBUILD)
  # Ten packages look for the same Python, and each search starts six interpreters.
  macro(find_package name)
    if(NOT ("${name}" STREQUAL Python3 AND Python3_NumPy_FOUND))
      _find_package(${ARGV})
    endif()
  endmacro()
endif()

macro(interface_package)
  cmake_parse_arguments(PACKAGE "UPSTREAM" "" "DEPENDENCIES" ${ARGN})

  if(SKBUILD)
    # The ROS packages are wheels in the environment of the Python that builds.
    find_package(Python3 REQUIRED COMPONENTS Interpreter Development.Module NumPy)
    execute_process(
      COMMAND "${Python3_EXECUTABLE}" -c "import sys; print(sys.prefix)"
      OUTPUT_VARIABLE PACKAGE_PREFIX OUTPUT_STRIP_TRAILING_WHITESPACE COMMAND_ERROR_IS_FATAL ANY)
    list(PREPEND CMAKE_PREFIX_PATH "${PACKAGE_PREFIX}")
    set(ENV{AMENT_PREFIX_PATH} "${PACKAGE_PREFIX}")
  elseif(PACKAGE_UPSTREAM)
    find_package(${PROJECT_NAME} QUIET)
    string(FIND "${${PROJECT_NAME}_DIR}/" "${CMAKE_INSTALL_PREFIX}/" PACKAGE_AT)
    if(${PROJECT_NAME}_FOUND AND NOT PACKAGE_AT EQUAL 0)
      message(STATUS "${PROJECT_NAME} is installed (${${PROJECT_NAME}_DIR}): nothing to build")
      return()
    endif()
  endif()

  find_package(ament_cmake REQUIRED)
  find_package(rosidl_default_generators REQUIRED)
  foreach(dependency ${PACKAGE_DEPENDENCIES})
    find_package(${dependency} REQUIRED)
  endforeach()

  if(SKBUILD)
    # Python over rmw_fastrtps needs the C side only: leave out what only C++ nodes use (half of the build time). The
    # introspection type support stays: the middleware describes types by it.
    list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
    foreach(generator generator_type_description generator_c generator_py typesupport_c typesupport_fastrtps_c
            typesupport_introspection_c)
      list(PREPEND rosidl_${generator}_BIN "${INTERFACE_PACKAGE_FOLDER}/run_generator.py")
    endforeach()
    # Python imports this one alone, which finds the other type supports.
    macro(rosidl_generator_py_get_typesupports supports)
      set(${supports} rosidl_typesupport_c)
    endmacro()
    # Messages pass as fast as with -O1 (Fast CDR and CPython take the time), which takes twice as long to compile.
    set(CMAKE_C_FLAGS_RELEASE -O0)
    set(CMAKE_CXX_FLAGS_RELEASE -O0)
  endif()

  file(GLOB PACKAGE_FILES RELATIVE "${CMAKE_CURRENT_SOURCE_DIR}" CONFIGURE_DEPENDS msg/*.msg srv/*.srv action/*.action)
  rosidl_generate_interfaces(${PROJECT_NAME} ${PACKAGE_FILES} DEPENDENCIES ${PACKAGE_DEPENDENCIES})
  drop_missing_include_folders()
  if(SKBUILD)
    # Headers (Fast CDR, Python, NumPy) take longer to compile than what is generated: one translation unit a library.
    # Descriptions of types stay apart, because their static names repeat.
    foreach(library generator_c generator_py typesupport_c typesupport_fastrtps_c typesupport_introspection_c)
      set_target_properties(${PROJECT_NAME}__rosidl_${library} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
    endforeach()
    get_target_property(sources ${PROJECT_NAME}__rosidl_generator_c SOURCES)
    list(FILTER sources INCLUDE REGEX "__description\\.c$")
    set_source_files_properties(${sources} PROPERTIES SKIP_UNITY_BUILD_INCLUSION ON)
  endif()

  ament_export_dependencies(rosidl_default_runtime)
  ament_package()
endmacro()
