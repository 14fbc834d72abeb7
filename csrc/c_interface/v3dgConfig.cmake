include("${CMAKE_CURRENT_LIST_DIR}/v3dgTargets.cmake")
