#include "bindings/args.h"

namespace v3dg {

void bind_cluster(py::module_&) {}

}  // namespace v3dg
