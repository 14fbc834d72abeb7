#include "io/ply_fields.h"

#include <string>
#include <unordered_map>
#include <unordered_set>

namespace v3dg {

static std::vector<std::string> slot_names(size_t num_sh) {
    std::vector<std::string> names = {"x",     "y",       "z",       "rot_0",   "rot_1",  "rot_2",
                                      "rot_3", "scale_0", "scale_1", "scale_2", "opacity"};
    for (size_t k = 0; k < num_sh; ++k)
        for (size_t c = 0; c < 3; ++c)
            names.push_back(k == 0 ? "f_dc_" + std::to_string(c)
                                   : "f_rest_" + std::to_string(c * (num_sh - 1) + k - 1));
    return names;
}

size_t num_sh_of(const PlyElement& vertex) {
    size_t num_rest = 0;
    for (const PlyProperty& property : vertex.properties)
        num_rest += property.name.rfind("f_rest_", 0) == 0;
    for (const size_t num_sh : {1, 4, 9, 16})
        if (num_rest == 3 * (num_sh - 1)) return num_sh;
    throw PlyError("expected 0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3), got " +
                   std::to_string(num_rest));
}

static std::string missing_text(const PlyElement& vertex, const std::vector<std::string>& missing) {
    std::string text = "expected vertex properties ";
    constexpr size_t kMaxNames = 8;
    for (size_t i = 0; i < missing.size() && i < kMaxNames; ++i)
        text += (i == 0 ? "" : ", ") + missing[i];
    if (missing.size() > kMaxNames)
        text += " and " + std::to_string(missing.size() - kMaxNames) + " more";
    text += ", got ";
    for (size_t i = 0; i < vertex.properties.size() && i < kMaxNames; ++i)
        text += (i == 0 ? "" : ", ") + quoted(vertex.properties[i].name);
    if (vertex.properties.empty()) text += "none";
    if (vertex.properties.size() > kMaxNames)
        text += " and " + std::to_string(vertex.properties.size() - kMaxNames) + " more";
    return text + (missing.size() < 4 ? "" : "; this is not a file of gaussians");
}

std::vector<PlyField> fields_of(const PlyElement& vertex, size_t num_sh) {
    std::unordered_map<std::string, PlyField> field_from_name;
    std::unordered_set<std::string> lists;
    size_t offset = 0;
    for (size_t p = 0; p < vertex.properties.size(); ++p) {
        const PlyProperty& property = vertex.properties[p];
        const bool is_new =
            property.is_list
                ? lists.insert(property.name).second && !field_from_name.count(property.name)
                : field_from_name.insert({property.name, {p, offset, property.type}}).second &&
                      !lists.count(property.name);
        if (!is_new)
            throw PlyError("expected each vertex property once, got " + quoted(property.name) +
                           " twice");
        if (!property.is_list) offset += size_of(property.type);
    }
    std::vector<PlyField> fields;
    std::vector<std::string> missing;
    for (const std::string& name : slot_names(num_sh)) {
        const auto field = field_from_name.find(name);
        if (lists.count(name))
            throw PlyError("expected a number as vertex property " + quoted(name) + ", got a list");
        if (field == field_from_name.end())
            missing.push_back(name);
        else
            fields.push_back(field->second);
    }
    if (!missing.empty()) throw PlyError(missing_text(vertex, missing));
    return fields;
}

}  // namespace v3dg
