# Finds ONNX Runtime: ORT_INCLUDE, ORT_LIBRARY, and ORT_ALIAS, a link to the library under the name that programs look
# for. In this order: what -DORT_ROOT=FOLDER names, what the system has, the library of the Python package.
set(ORT_ROOT "" CACHE PATH "Folder with ONNX Runtime's include/ and lib/, or with its include/ alone")

find_path(ORT_INCLUDE onnxruntime_cxx_api.h HINTS ${ORT_ROOT} PATH_SUFFIXES include include/onnxruntime onnxruntime)
if(NOT ORT_INCLUDE)
  message(FATAL_ERROR "ONNX Runtime's headers (onnxruntime_cxx_api.h, of 1.21 or newer) are not found. "
    "Pass -DORT_ROOT=FOLDER, FOLDER/include being where they are. They are in Debian 13's package libonnxruntime-dev, "
    "in https://github.com/microsoft/onnxruntime/releases, and in conda-forge's onnxruntime-cpp; "
    "docs/embed/c-library.md has the commands.")
endif()

find_library(ORT_LIBRARY onnxruntime HINTS ${ORT_ROOT} PATH_SUFFIXES lib)
if(NOT ORT_LIBRARY)
  find_package(Python3 COMPONENTS Interpreter QUIET)
  if(Python3_FOUND)
    execute_process(OUTPUT_VARIABLE folder ERROR_QUIET OUTPUT_STRIP_TRAILING_WHITESPACE COMMAND ${Python3_EXECUTABLE} -c
      "from importlib.util import find_spec; print(find_spec('onnxruntime').submodule_search_locations[0])")
  endif()
  # Their names end in the version, so that `find_library` does not see them.
  file(GLOB found ${ORT_ROOT}/lib/libonnxruntime.so.1.* ${folder}/capi/libonnxruntime.so.1.*
       ${folder}/capi/libonnxruntime.1.*.dylib)
  if(NOT found)
    message(FATAL_ERROR "ONNX Runtime's library is not found. Pass -DORT_ROOT=FOLDER, FOLDER/lib being where it is, or "
      "pip install onnxruntime, whose library is taken where python3 finds the package "
      "(-DPython3_EXECUTABLE=PROGRAM names another).")
  endif()
  list(GET found 0 found)
  set(ORT_LIBRARY ${found} CACHE FILEPATH "ONNX Runtime's library" FORCE)
endif()
message(STATUS "ONNX Runtime: ${ORT_INCLUDE}, ${ORT_LIBRARY}")

# The library calls itself libonnxruntime.so.1, so programs look for that; the Python package has no such file.
unset(ORT_ALIAS)
get_filename_component(folder ${ORT_LIBRARY} DIRECTORY)
if(ORT_LIBRARY MATCHES "[.]so[.]1[.][0-9]+[.][0-9]+$" AND NOT EXISTS ${folder}/libonnxruntime.so.1)
  set(ORT_ALIAS ${CMAKE_CURRENT_BINARY_DIR}/libonnxruntime.so.1)
  file(CREATE_LINK ${ORT_LIBRARY} ${ORT_ALIAS} SYMBOLIC)
endif()
