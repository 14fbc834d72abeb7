#pragma once

// What a mutex guards and which functions need it, in words that clang checks.
//
// `clang++ -Wthread-safety` reads these attributes (.ci/check_threads.py runs it); for other
// compilers they are empty. base/mutex.h has the types that they apply to.

#if defined(__clang__)
#define V3DG_THREAD_ATTRIBUTE(...) __attribute__((__VA_ARGS__))
#else
#define V3DG_THREAD_ATTRIBUTE(...)
#endif

// A type that can be held, and one that holds another from its construction to its destruction.
#define V3DG_CAPABILITY(name) V3DG_THREAD_ATTRIBUTE(capability(name))
#define V3DG_SCOPED_CAPABILITY V3DG_THREAD_ATTRIBUTE(scoped_lockable)

// A variable that is read and written only while the mutex is held.
#define V3DG_GUARDED_BY(mutex) V3DG_THREAD_ATTRIBUTE(guarded_by(mutex))

// A function whose caller holds the mutex, or must not hold it.
#define V3DG_REQUIRES(...) V3DG_THREAD_ATTRIBUTE(requires_capability(__VA_ARGS__))
#define V3DG_EXCLUDES(...) V3DG_THREAD_ATTRIBUTE(locks_excluded(__VA_ARGS__))

// A function that takes or releases the mutex, or takes it if it returns `success`.
#define V3DG_ACQUIRE(...) V3DG_THREAD_ATTRIBUTE(acquire_capability(__VA_ARGS__))
#define V3DG_RELEASE(...) V3DG_THREAD_ATTRIBUTE(release_capability(__VA_ARGS__))
#define V3DG_TRY_ACQUIRE(success, ...) \
    V3DG_THREAD_ATTRIBUTE(try_acquire_capability(success, ##__VA_ARGS__))
