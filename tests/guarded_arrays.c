/* An allocator for NumPy with which reading beyond an array ends the process at once, instead of once in a thousand runs.

   Each array ends where a page begins that must not be read. Its size stands in 16 bytes before it. Each needs
   two maps of memory, of which Linux gives a process 65,530: where many arrays are alive, further ones come from malloc. */
#define NPY_NO_DEPRECATED_API NPY_1_22_API_VERSION
#include <Python.h>
#include <numpy/arrayobject.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

typedef struct {
    size_t mapped; /* Bytes in front of the page that must not be read; 0 for memory of malloc. */
    size_t size;   /* Of the array. */
} Header;

/* Guarded arrays at a time. */
#define MOST 20000

static size_t page, live;

static void *take(void *context, size_t size) {
    size_t used = size ? (size + 15) & ~(size_t) 15 : 16;
    size_t mapped = (used + sizeof(Header) + page - 1) / page * page;
    char *memory, *array;
    if (__atomic_load_n(&live, __ATOMIC_RELAXED) < MOST) {
        memory = mmap(NULL, mapped + page, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (memory == MAP_FAILED || mprotect(memory + mapped, page, PROT_NONE))
            return NULL;
        array = memory + mapped - used;
        __atomic_add_fetch(&live, 1, __ATOMIC_RELAXED);
    } else {
        memory = calloc(1, used + sizeof(Header));
        if (!memory)
            return NULL;
        mapped = 0;
        array = memory + sizeof(Header);
    }
    Header *header = (Header *) array - 1;
    header->mapped = mapped;
    header->size = size;
    return array;
}

static void *take_zeros(void *context, size_t count, size_t size) { return take(context, count * size); }

static void give(void *context, void *array, size_t size) {
    if (!array)
        return;
    Header *header = (Header *) array - 1;
    size_t mapped = header->mapped, used = header->size ? (header->size + 15) & ~(size_t) 15 : 16;
    if (mapped) {
        munmap((char *) array + used - mapped, mapped + page);
        __atomic_sub_fetch(&live, 1, __ATOMIC_RELAXED);
    } else
        free(header);
}

static void *take_again(void *context, void *array, size_t size) {
    void *other = take(context, size);
    if (array && other) {
        size_t before = ((Header *) array - 1)->size;
        memcpy(other, array, before < size ? before : size);
        give(context, array, before);
    }
    return other;
}

static PyDataMem_Handler handler = {"guarded", 1, {NULL, take, take_zeros, take_again, give}};

static PyObject *begin(PyObject *self, PyObject *none) {
    PyObject *capsule = PyCapsule_New(&handler, "mem_handler", NULL);
    PyObject *before = capsule ? PyDataMem_SetHandler(capsule) : NULL;
    Py_XDECREF(capsule);
    if (!before)
        return NULL;
    Py_DECREF(before);
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"begin", begin, METH_NOARGS, "Guard the arrays that are made from now on."},
    {NULL},
};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_guarded_arrays", NULL, -1, methods};

PyMODINIT_FUNC PyInit__guarded_arrays(void) {
    import_array();
    page = (size_t) sysconf(_SC_PAGESIZE);
    return PyModule_Create(&module);
}
