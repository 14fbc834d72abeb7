// Finds the properties of a vertex that make a gaussian, in files of the 3DGS code and
// of other trainers. If properties are missing, the error text says what kind of file
// it probably is.

#include "io/ply_fields.h"

#include <algorithm>
#include <string>
#include <unordered_map>
#include <unordered_set>

namespace v3dg {

namespace {

constexpr size_t kMaxNames = 8;  // maximum number of property names in an error text

// Prefixes of property names, except for positions, normals and colours. They are those
// of CloudCompare, of 3dgsconverter, and of both.
constexpr const char* kPrefixes[] = {"scalar_", "scal_", "scalar_scal_"};

// Returns the prefix of the property names of gaussians. It is empty for files that
// trainers write.
std::string prefix_of(const PlyElement& vertex) {
    std::unordered_set<std::string> names;
    for (const PlyProperty& property : vertex.properties) names.insert(property.name);
    if (names.count("opacity")) return "";
    for (const char* prefix : kPrefixes)
        if (names.count(std::string(prefix) + "opacity")) return prefix;
    return "";
}

// Returns the element with the property names that trainers use. If another property
// already has the name without the prefix, the prefix is kept.
PlyElement without_prefix(PlyElement vertex, const std::string& prefix) {
    if (prefix.empty()) return vertex;
    std::unordered_set<std::string> names;
    for (const PlyProperty& property : vertex.properties) names.insert(property.name);
    for (PlyProperty& property : vertex.properties) {
        if (property.name.rfind(prefix, 0) != 0) continue;
        const std::string name = property.name.substr(prefix.size());
        if (!names.count(name)) property.name = name;
    }
    return vertex;
}

// The numbers in a vertex, by name. `lists` are the names of its lists.
struct Fields {
    std::unordered_map<std::string, PlyField> field_from_name;
    std::unordered_set<std::string> lists;

    bool has(const std::string& name) const { return field_from_name.count(name) != 0; }
};

Fields fields_of(const PlyElement& vertex) {
    Fields fields;
    size_t offset = 0;
    for (size_t p = 0; p < vertex.properties.size(); ++p) {
        const PlyProperty& property = vertex.properties[p];
        const std::string& name = property.name;
        if (fields.has(name) || fields.lists.count(name))
            throw PlyError("expected each vertex property once, got " + in_quotes(name) + " twice");
        if (property.is_list) {
            fields.lists.insert(name);
        } else {
            fields.field_from_name.insert({name, {p, offset, property.type}});
            offset += size_of(property.type);
        }
    }
    return fields;
}

// Returns K, the number of SH coefficients per channel in the file.
size_t num_stored_sh(const PlyElement& vertex) {
    size_t num_rest = 0;
    for (const PlyProperty& property : vertex.properties)
        num_rest += property.name.rfind("f_rest_", 0) == 0;
    for (const size_t num_sh : {1, 4, 9, 16, 25})
        if (num_rest == 3 * (num_sh - 1)) return num_sh;
    throw PlyError("expected 0, 9, 24, 45 or 72 properties f_rest_* (SH degree 0 to 4), got " +
                   std::to_string(num_rest));
}

// Returns the names of the properties that have base colours. There are none if the
// file has SH coefficients, or no colours at all.
std::vector<std::string> base_color_names(const Fields& fields) {
    if (fields.has("f_dc_0")) return {};
    for (const std::vector<std::string>& names :
         {std::vector<std::string>{"red", "green", "blue"}, {"r", "g", "b"}})
        if (fields.has(names[0]) && fields.has(names[1]) && fields.has(names[2])) return names;
    return {};
}

double color_scale(const std::string& name, PlyType type) {
    switch (type) {
        case PlyType::uint8: return 1.0 / 255;
        case PlyType::uint16: return 1.0 / 65535;
        case PlyType::float16:
        case PlyType::float32:
        case PlyType::float64: return 1;
        default:
            throw PlyError("expected a colour " + in_quotes(name) +
                           " of the type uchar, ushort or float, got another type");
    }
}

// Returns the name of the property of each slot. It is empty if the file does not have
// the slot.
std::vector<std::string> slot_names(const Fields& fields, size_t num_stored, PlyLayout& layout) {
    std::vector<std::string> names = {"x",     "y",       "z",       "rot_0",   "rot_1",  "rot_2",
                                      "rot_3", "scale_0", "scale_1", "scale_2", "opacity"};
    if (layout.is_flat) names[kScale + 2].clear();
    names.push_back(layout.has_filter ? "filter_3D" : "");
    const std::vector<std::string> colors = base_color_names(fields);
    for (size_t k = 0; k < layout.num_sh; ++k)
        for (size_t c = 0; c < 3; ++c) {
            if (k > 0)
                names.push_back("f_rest_" + std::to_string(c * (num_stored - 1) + k - 1));
            else
                names.push_back(colors.empty() ? "f_dc_" + std::to_string(c) : colors[c]);
        }
    for (size_t c = 0; c < colors.size(); ++c)
        layout.color_scale[c] = color_scale(colors[c], fields.field_from_name.at(colors[c]).type);
    layout.has_base_colors = !colors.empty();
    return names;
}

// Returns what to say about a file without the required properties: what kind of file
// it is, and what to do.
std::string advice(const Fields& fields, size_t num_missing) {
    if (fields.has("f_anchor_feat_0"))
        return "; this file has the anchors of Scaffold-GS, of which a network makes gaussians: "
               "export gaussians with its code";
    const bool is_cloud = fields.has("x") && fields.has("y") && fields.has("z") &&
                          !fields.has("opacity") && !fields.has("scale_0") && !fields.has("rot_0");
    if (is_cloud)
        return "; this is a point cloud or a mesh, not a file of gaussians: train gaussians that "
               "start from it, and open the .ply that the trainer writes";
    return num_missing < 4 ? "" : "; this is not a file of gaussians";
}

std::string missing_text(const PlyElement& vertex, const Fields& fields,
                         const std::vector<std::string>& missing) {
    std::string text = "expected vertex properties ";
    for (size_t i = 0; i < missing.size() && i < kMaxNames; ++i)
        text += (i == 0 ? "" : ", ") + missing[i];
    if (missing.size() > kMaxNames)
        text += " and " + std::to_string(missing.size() - kMaxNames) + " more";
    text += ", got ";
    for (size_t i = 0; i < vertex.properties.size() && i < kMaxNames; ++i)
        text += (i == 0 ? "" : ", ") + in_quotes(vertex.properties[i].name);
    if (vertex.properties.empty()) text += "none";
    if (vertex.properties.size() > kMaxNames)
        text += " and " + std::to_string(vertex.properties.size() - kMaxNames) + " more";
    return text + advice(fields, missing.size());
}

}  // namespace

PlyLayout layout_of(const PlyElement& stored) {
    PlyLayout layout;
    layout.prefix = prefix_of(stored);
    const PlyElement vertex = without_prefix(stored, layout.prefix);
    const Fields fields = fields_of(vertex);
    const size_t num_stored = num_stored_sh(vertex);
    layout.num_sh = std::min<size_t>(num_stored, kMaxShBases);
    layout.is_flat = fields.has("scale_0") && fields.has("scale_1") && !fields.has("scale_2") &&
                     !fields.lists.count("scale_2") && fields.has("rot_0");
    layout.has_filter = fields.has("filter_3D");
    std::vector<std::string> missing;
    for (const std::string& name : slot_names(fields, num_stored, layout)) {
        if (fields.lists.count(name))
            throw PlyError("expected a number as vertex property " + in_quotes(name) +
                           ", got a list");
        const auto field = fields.field_from_name.find(name);
        if (field != fields.field_from_name.end())
            layout.fields.push_back(field->second);
        else
            layout.fields.push_back({PlyField::kNone, 0, PlyType::float32});
        if (field == fields.field_from_name.end() && !name.empty()) missing.push_back(name);
    }
    if (!missing.empty()) throw PlyError(missing_text(vertex, fields, missing));
    return layout;
}

}  // namespace v3dg
