/* Feeds the arrays of an engine: v3dg_engine_arrays FILE OUTPUT
 *
 * An engine has memory for a fixed number of pages. In each frame it selects a cut of its
 * resident pages, and reads the most urgent missing pages. When no page is missing, the
 * positions, scales, rotations and colours of the cut are arrays for any renderer of
 * gaussians. They are written to OUTPUT as a .ply file of points for a viewer. */

#include <inttypes.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include <v3dg.h>

enum { MOST_FRAMES = 1000, PAGES_A_FRAME = 8, BUDGET = 200000 };

/* The arrays of an engine. */
typedef struct arrays {
    uint64_t count;
    float* positions; /* x, y, z in the world */
    float* scales;    /* standard deviations along the axes */
    float* rotations; /* w, x, y, z */
    float* opacities; /* 0 to 1 */
    float* colors;    /* red, green, blue */
} arrays;

static void stop(const char* problem) {
    fprintf(stderr, "%s\n", problem);
    exit(1);
}

static void check(v3dg_status status) {
    if (status != V3DG_OK) stop(v3dg_last_error());
}

static void* allocate(uint64_t size) {
    void* memory = calloc(size > 0 ? size : 1, 1);
    if (memory == NULL) stop("memory: expected more, got none");
    return memory;
}

/* Marks the last page of each bundle, which has the coarsest level, as resident. */
static uint8_t** first_pages(v3dg_scene* scene, uint32_t num_bundles) {
    uint8_t** is_resident = allocate(num_bundles * sizeof *is_resident);
    for (uint32_t b = 0; b < num_bundles; ++b) {
        v3dg_bundle_info bundle;
        check(v3dg_get_bundle_info(scene, b, &bundle));
        is_resident[b] = allocate(bundle.num_pages);
        if (bundle.num_pages > 0) is_resident[b][bundle.num_pages - 1] = 1;
        check(v3dg_set_resident(scene, b, is_resident[b], bundle.num_pages));
    }
    return is_resident;
}

/* Reads a page and marks it as resident. An engine would copy it to its memory here. */
static void load(v3dg_scene* scene, v3dg_missing_page missing, uint8_t** is_resident) {
    v3dg_bundle_info bundle;
    v3dg_page_info page;
    void* bytes;
    check(v3dg_get_bundle_info(scene, missing.bundle, &bundle));
    check(v3dg_get_page_info(scene, missing.bundle, missing.page, &page));
    bytes = allocate(page.num_bytes);
    check(v3dg_read_page(scene, missing.bundle, missing.page, bytes, page.num_bytes));
    free(bytes);
    is_resident[missing.bundle][missing.page] = 1;
    check(v3dg_set_resident(scene, missing.bundle, is_resident[missing.bundle], bundle.num_pages));
}

/* Selects a cut in each frame, until no page is missing that the cut needs now. */
static v3dg_cut* settled_cut(v3dg_scene* scene, const v3dg_camera* camera, uint8_t** is_resident) {
    v3dg_rule rule = V3DG_DEFAULT_RULE;
    rule.fade = 1.02;
    rule.budget = BUDGET;
    for (int frame = 0; frame < MOST_FRAMES; ++frame) {
        v3dg_cut* cut;
        uint64_t num_loaded = 0;
        check(v3dg_select(scene, camera, 1, &rule, &cut));
        while (num_loaded < cut->num_missing && num_loaded < PAGES_A_FRAME &&
               cut->missing[num_loaded].priority > 1)
            load(scene, cut->missing[num_loaded++], is_resident);
        printf("frame %d: %" PRIu64 " gaussians, %" PRIu64 " pages missing or needed soon\n", frame,
               cut->num_gaussians, cut->num_missing);
        if (num_loaded == 0) return cut;
        v3dg_free_cut(cut);
    }
    stop("frames: expected a cut that misses nothing, got none");
    return NULL;
}

static arrays arrays_of_cut(const v3dg_scene* scene, const v3dg_cut* cut) {
    arrays out = {0};
    v3dg_gaussians memory = {0};
    out.count = cut->num_gaussians;
    out.positions = allocate(3 * out.count * sizeof(float));
    out.scales = allocate(3 * out.count * sizeof(float));
    out.rotations = allocate(4 * out.count * sizeof(float));
    out.opacities = allocate(out.count * sizeof(float));
    out.colors = allocate(3 * out.count * sizeof(float));
    memory.means = out.positions;
    memory.quaternions = out.rotations;
    memory.scales = out.scales;
    memory.opacities = out.opacities;
    memory.sh = out.colors; /* coefficients of degree 0, which become colours below */
    memory.capacity = out.count;
    check(v3dg_read_cut(scene, cut, NULL, &memory));
    for (uint64_t i = 0; i < 3 * out.count; ++i) {
        const float color = 0.28209479f * out.colors[i] + 0.5f;
        out.colors[i] = color < 0 ? 0 : color > 1 ? 1 : color;
    }
    return out;
}

static void write_points(const arrays* points, const char* path) {
    FILE* file = fopen(path, "w");
    if (file == NULL) stop("OUTPUT: expected a file that can be written, got another");
    fprintf(file,
            "ply\nformat ascii 1.0\nelement vertex %" PRIu64
            "\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n"
            "property uchar green\nproperty uchar blue\nend_header\n",
            points->count);
    for (uint64_t i = 0; i < points->count; ++i) {
        const float* p = points->positions + 3 * i;
        const float* c = points->colors + 3 * i;
        fprintf(file, "%g %g %g %d %d %d\n", p[0], p[1], p[2], (int)(255 * c[0] + 0.5f),
                (int)(255 * c[1] + 0.5f), (int)(255 * c[2] + 0.5f));
    }
    if (fclose(file) != 0) stop("OUTPUT: expected room for the file, got none");
}

int main(int num_arguments, char** arguments) {
    const double eye[3] = {0, -3, 0.5};
    const double target[3] = {0, 0, 0};
    const double up[3] = {0, 0, 1};
    v3dg_scene* scene = NULL;
    v3dg_scene_info info;
    v3dg_camera camera;
    uint8_t** is_resident;
    v3dg_cut* cut;
    arrays points;

    if (num_arguments != 3) stop("usage: v3dg_engine_arrays FILE OUTPUT");
    check(v3dg_open(arguments[1], &scene));
    check(v3dg_get_scene_info(scene, &info));
    check(v3dg_look_at(eye, target, up, 0.8, 1280, 720, 0.01, &camera));
    if (info.num_cameras > 0) check(v3dg_get_camera(scene, 0, &camera, NULL));
    is_resident = first_pages(scene, info.num_bundles);
    cut = settled_cut(scene, &camera, is_resident);
    points = arrays_of_cut(scene, cut);
    write_points(&points, arguments[2]);
    printf("%" PRIu64 " gaussians written to %s\n", points.count, arguments[2]);

    free(points.positions);
    free(points.scales);
    free(points.rotations);
    free(points.opacities);
    free(points.colors);
    for (uint32_t b = 0; b < info.num_bundles; ++b) free(is_resident[b]);
    free(is_resident);
    v3dg_free_cut(cut);
    v3dg_close(scene);
    return 0;
}
