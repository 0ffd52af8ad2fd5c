// Functions for Python, whose arguments and results are converted by their C++ types. A part of core.cpp, and of the kernel
// for highway-env.

// Thrown where an exception of Python is set.
struct Raised {};

template <typename... Values> [[noreturn]] void raise(PyObject *kind, const char *format, Values... values) {
    PyErr_Format(kind, format, values...);
    throw Raised();
}

// The result of a function of Python's, which is -1 if it has set an exception.
template <typename Value> Value checked(Value value) {
    if (value == static_cast<Value>(-1) && PyErr_Occurred()) {
        throw Raised();
    }
    return value;
}

// A reference that is owned; null without an object.
struct Ref {
    PyObject *object = nullptr;

    Ref() = default;
    explicit Ref(PyObject *owned) : object(owned) {}
    Ref(Ref &&other) noexcept : object(other.give()) {}
    Ref &operator=(Ref &&other) noexcept {
        std::swap(object, other.object);
        return *this;
    }
    ~Ref() { Py_XDECREF(object); }
    explicit operator bool() const { return object; }
    PyObject *give() { return std::exchange(object, nullptr); }
};

// A view of an object's memory; the object stays as long as the view.
struct Buffer {
    Py_buffer view = {};

    Buffer() = default;
    Buffer(PyObject *object, int flags) {
        if (!open(object, flags)) {
            throw Raised();
        }
    }
    Buffer(Buffer &&other) noexcept : view(std::exchange(other.view, Py_buffer{})) {}
    ~Buffer() { PyBuffer_Release(&view); }
    bool open(PyObject *object, int flags) { return PyObject_GetBuffer(object, &view, flags) == 0; }
    char *bytes() const { return static_cast<char *>(view.buf); }
    size_t size() const { return static_cast<size_t>(view.len); }
};

// A name as libsumo's own getters take it; false with an exception.
bool encode_name(PyObject *name, std::string &encoded) {
    Py_ssize_t size;
    if (const char *known = PyUnicode_AsUTF8AndSize(name, &size)) {
        encoded.assign(known, static_cast<size_t>(size));
        return true;
    }
    PyErr_Clear();
    const Ref text(PyUnicode_AsEncodedString(name, "utf-8", "surrogateescape"));
    if (text) {
        encoded.assign(PyBytes_AS_STRING(text.object), static_cast<size_t>(PyBytes_GET_SIZE(text.object)));
    }
    return bool(text);
}

PyObject *text_of(const std::string &text) {
    return PyUnicode_DecodeUTF8(text.data(), static_cast<Py_ssize_t>(text.size()), "surrogateescape");
}

// An object of exactly this type, which is borrowed, as every argument.
template <PyTypeObject *type> struct Exact {
    PyObject *object;
    operator PyObject *() const { return object; }
};
typedef Exact<&PyDict_Type> Dict;
typedef Exact<&PyList_Type> List;
typedef Exact<&PyTuple_Type> Tuple;

// An argument as a C++ value.
template <typename Value> struct From;
template <> struct From<PyObject *> {
    static PyObject *of(PyObject *given) { return given; }
};
template <> struct From<double> {
    static double of(PyObject *given) { return checked(PyFloat_AsDouble(given)); }
};
template <> struct From<bool> {
    static bool of(PyObject *given) { return checked(PyObject_IsTrue(given)); }
};
template <> struct From<int> {
    static int of(PyObject *given) { return static_cast<int>(checked(PyLong_AsLong(given))); }
};
template <> struct From<long> { // also of Py_ssize_t
    static long of(PyObject *given) { return checked(PyLong_AsLong(given)); }
};
template <> struct From<long long> {
    static long long of(PyObject *given) { return checked(PyLong_AsLongLong(given)); }
};
template <> struct From<size_t> {
    static size_t of(PyObject *given) {
        const long value = From<long>::of(given);
        return value < 0 ? raise(PyExc_ValueError, "a number is negative"), 0 : static_cast<size_t>(value);
    }
};
template <> struct From<std::string> {
    static std::string of(PyObject *given) {
        std::string name;
        if (!PyUnicode_Check(given)) {
            raise(PyExc_TypeError, "a name is no text");
        }
        return encode_name(given, name) ? name : throw Raised();
    }
};
template <PyTypeObject *type> struct From<Exact<type>> {
    static Exact<type> of(PyObject *given) {
        if (Py_TYPE(given) != type) {
            raise(PyExc_TypeError, "this is no %s", type->tp_name);
        }
        return {given};
    }
};
template <typename... Values> struct From<std::tuple<Values...>> {
    template <size_t... places>
    static std::tuple<Values...> each(PyObject *const *given, std::index_sequence<places...>) {
        return {From<Values>::of(given[places])...}; // in this order
    }
    static std::tuple<Values...> of(PyObject *const *given, Py_ssize_t count) {
        if (count != sizeof...(Values)) {
            raise(PyExc_TypeError, "%zd values are given instead of %zu", count, sizeof...(Values));
        }
        return each(given, std::index_sequence_for<Values...>());
    }
    static std::tuple<Values...> of(PyObject *given) {
        PyObject *tuple = From<Tuple>::of(given);
        return of(reinterpret_cast<PyTupleObject *>(tuple)->ob_item, PyTuple_GET_SIZE(tuple));
    }
};
template <typename Value> struct From<std::vector<Value>> {
    static std::vector<Value> of(PyObject *given) {
        const bool is_list = PyList_CheckExact(given);
        PyObject *whole = is_list ? given : From<Tuple>::of(given).object;
        std::vector<Value> values;
        for (Py_ssize_t place = 0; place < PySequence_Fast_GET_SIZE(whole); place++) {
            values.push_back(From<Value>::of(PySequence_Fast_GET_ITEM(whole, place)));
        }
        return values;
    }
};

// A result as a new object; null with an exception.
inline PyObject *to_python(PyObject *made) { return made; }
inline PyObject *to_python(bool value) { return PyBool_FromLong(value); }
inline PyObject *to_python(int value) { return PyLong_FromLong(value); }
inline PyObject *to_python(long long value) { return PyLong_FromLongLong(value); }
inline PyObject *to_python(size_t value) { return PyLong_FromSize_t(value); }
inline PyObject *to_python(double value) { return PyFloat_FromDouble(value); }
inline PyObject *to_python(const std::string &value) { return text_of(value); }
inline PyObject *to_python(const Ref &value) { return Py_XNewRef(value.object); }
template <typename... Values> PyObject *to_python(const std::tuple<Values...> &values);
template <typename Value> PyObject *to_python(const std::vector<Value> &values);
template <typename Value> PyObject *to_python(const std::optional<Value> &value) {
    return value ? to_python(*value) : Py_NewRef(Py_None);
}
template <typename... Values> PyObject *to_python(const std::tuple<Values...> &values) {
    Ref made(PyTuple_New(sizeof...(Values)));
    Py_ssize_t place = 0;
    bool good = bool(made);
    const auto put = [&](PyObject *part) {
        good = good && part;
        good ? PyTuple_SET_ITEM(made.object, place++, part) : Py_XDECREF(part);
    };
    std::apply([&](const auto &...each) { (put(to_python(each)), ...); }, values);
    return good ? made.give() : nullptr;
}
// Other code must not see a list that is filled in part; the garbage collector knows which entries are empty.
template <typename Value> PyObject *to_python(const std::vector<Value> &values) {
    Ref list(PyList_New(static_cast<Py_ssize_t>(values.size())));
    for (size_t place = 0; list && place < values.size(); place++) {
        PyObject *part = to_python(values[place]);
        if (part) {
            PyList_SET_ITEM(list.object, static_cast<Py_ssize_t>(place), part);
        } else {
            list = Ref();
        }
    }
    return list.give();
}

// Runs a function for Python. Where one of libsumo's own exceptions comes, it returns None: its getters raise the same.
template <typename Do> PyObject *run(const Do &function) {
    try {
        if constexpr (std::is_void_v<decltype(function())>) {
            function();
            Py_RETURN_NONE;
        } else {
            return to_python(function());
        }
    } catch (const Raised &) {
        return nullptr;
    } catch (...) {
        Py_RETURN_NONE;
    }
}

// Functions and methods as Python calls them, for a PyMethodDef.
template <auto function> struct Function;
template <typename Result, typename... Values, Result (*function)(Values...)> struct Function<function> {
    static PyObject *call(PyObject *, PyObject *const *given, Py_ssize_t count) {
        return run([&] { return std::apply(function, From<std::tuple<Values...>>::of(given, count)); });
    }
};
template <typename Self> Self &self_of(PyObject *object);
template <auto function> struct Method;
template <typename Self, typename Result, typename... Values, Result (*function)(Self &, Values...)>
struct Method<function> {
    static PyObject *call(PyObject *self, PyObject *const *given, Py_ssize_t count) {
        return run([&] {
            return std::apply(function, std::tuple_cat(std::tie(self_of<Self>(self)),
                                                       From<std::tuple<Values...>>::of(given, count)));
        });
    }
};
#define FAST(function) reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(function)), METH_FASTCALL
#define FUNCTION(function) FAST(Function<function>::call)
#define METHOD(function) FAST(Method<function>::call)

// A class whose objects hold a C++ object, which a function makes of the arguments.
template <typename Object, auto held, auto make> struct Class;
template <typename Object, typename Held, Held *Object::*held, typename... Values, std::unique_ptr<Held> (*make)(Values...)>
struct Class<Object, held, make> {
    static PyObject *create(PyTypeObject *type, PyObject *arguments, PyObject *) {
        return run([&]() -> PyObject * {
            auto made = std::apply(make, From<std::tuple<Values...>>::of(arguments));
            PyObject *object = type->tp_alloc(type, 0);
            if (object) {
                reinterpret_cast<Object *>(object)->*held = made.release();
            }
            return object;
        });
    }
    static void destroy(PyObject *object) {
        PyTypeObject *type = Py_TYPE(object);
        delete (reinterpret_cast<Object *>(object)->*held);
        type->tp_free(object);
        Py_DECREF(type);
    }
};

PyGetSetDef no_getters[] = {{nullptr, nullptr, nullptr, nullptr, nullptr}};

// Adds a class to the module; Python can make objects of it if it has a constructor. Never given back: columns may
// outlive the module.
PyTypeObject *add_class(PyObject *module, const char *name, size_t size, newfunc create, destructor destroy,
                        PyMethodDef *methods, PyGetSetDef *getters, const char *about) {
    PyType_Slot slots[] = {
        {Py_tp_dealloc, reinterpret_cast<void *>(destroy)},
        {Py_tp_methods, methods},
        {Py_tp_getset, getters},
        {Py_tp_doc, const_cast<char *>(about)},
        {create ? Py_tp_new : 0, reinterpret_cast<void *>(create)},
        {0, nullptr},
    };
    const unsigned flags = Py_TPFLAGS_DEFAULT | (create ? 0 : Py_TPFLAGS_DISALLOW_INSTANTIATION);
    PyType_Spec spec = {name, static_cast<int>(size), 0, static_cast<unsigned>(flags), slots};
    PyObject *type = PyType_FromSpec(&spec);
    if (!type || PyModule_AddObjectRef(module, strrchr(name, '.') + 1, type) < 0) {
        Py_XDECREF(type);
        throw Raised();
    }
    return reinterpret_cast<PyTypeObject *>(type);
}

template <typename Object, auto held, auto make>
PyTypeObject *add_class(PyObject *module, const char *name, PyMethodDef *methods, PyGetSetDef *getters, const char *about) {
    typedef Class<Object, held, make> Made;
    return add_class(module, name, sizeof(Object), Made::create, Made::destroy, methods, getters, about);
}
