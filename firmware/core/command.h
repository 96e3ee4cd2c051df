/* Commands, cut from the bytes that arrive.
 *
 * A command is a letter and the fields that follow it, a semicolon behind each. What is no command
 * is dropped. A lost byte must never swallow the stop that follows it, therefore
 *
 * - a field that cannot stand where it stands ends the command before it and may begin another;
 * - a field that cannot stand anywhere but ends in the letter of a stop or a reset is that;
 * - an `s` that stood where a start has its wave was a stop, if that start then breaks off. */
#ifndef CARTLAB_COMMAND_H
#define CARTLAB_COMMAND_H

#include <stdbool.h>
#include <stdint.h>

#define MOST_ENCODERS 3
#define MOST_FIELDS (2 * MOST_ENCODERS + 1)
#define LONGEST_FIELD 32 /* characters */

typedef struct {
    char letter;                /* which command; 0: none */
    double fields[MOST_FIELDS]; /* of a field that is a letter, its code */
} Command;

typedef struct {
    uint8_t encoders; /* tells how many gains state feedback has */
    uint8_t length;   /* of the text so far */
    uint8_t count;    /* of the command's fields so far */
    char text[LONGEST_FIELD + 1];
    Command command; /* the one under way */
} CommandReader;

/* What a byte can bring about: neither, one or both, and the stop comes first. */
#define STOP_FOUND 1    /* a start that broke off was a stop */
#define COMMAND_FOUND 2 /* a command is complete and stands in reader->command */

uint8_t command_receive(CommandReader *reader, uint8_t byte);

#endif
