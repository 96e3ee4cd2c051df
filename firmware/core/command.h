/* Read commands from the bytes that arrive.
 *
 * A command is a letter and its fields, each with a semicolon after it. Anything else is dropped.
 * A lost byte must never hide the stop that follows it. Therefore
 *
 * - a field that is wrong in its place ends the command before it, and may begin another;
 * - a field that is wrong in any place but ends in the letter of a stop or a reset is that command;
 * - an `s` in the place of a start's wave was a stop, if that start then breaks off. */
#ifndef CARTLAB_COMMAND_H
#define CARTLAB_COMMAND_H

#include <stdbool.h>
#include <stdint.h>

#define MOST_ENCODERS 3
#define MOST_FIELDS (2 * MOST_ENCODERS + 1)
#define LONGEST_FIELD 32 /* characters */

typedef struct {
    char letter;                /* of the command; 0: no command */
    double fields[MOST_FIELDS]; /* numbers, or the codes of letters */
} Command;

typedef struct {
    uint8_t encoders; /* state feedback has two gains for each */
    uint8_t length;   /* of the text so far */
    uint8_t count;    /* of the command's fields so far */
    char text[LONGEST_FIELD + 1];
    Command command; /* the one under way */
} CommandReader;

/* What a byte can complete: neither, one or both; the stop is carried out first. */
#define STOP_FOUND 1    /* a start that broke off was a stop */
#define COMMAND_FOUND 2 /* reader->command is complete */

uint8_t command_receive(CommandReader *reader, uint8_t byte);

#endif
